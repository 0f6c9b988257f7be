"""The leases of a PostgreSQL store's missions: one owner at a time, by the database's clock."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import psycopg
import pytest
import sqlalchemy as sa
from psycopg.errors import DivisionByZero

from service.config.settings import Settings
from service.mission.resolved_spec import ResolvedSpec
from service.storage.leases import LeaseHolder, LeaseLost, Leases
from service.storage.locks import StoreUnusable
from service.storage.operations import Deleted, Made
from service.storage.rows import SCHEMA
from service.storage.store import Store
from shared.wire.schemas import MissionSpec
from tests.support.stored_missions import commit_changes
from tests.support.waiting import PATIENCE_S

TERM_S = 3600.0


@pytest.fixture
def store(postgres: str) -> Iterator[Store]:
    store = Store(postgres)
    with store._engine.begin() as db:
        db.exec_driver_sql("TRUNCATE leases, missions, checkpoints, journal")
    yield store
    store.close()


@pytest.fixture
def edges(store: Store) -> tuple[Leases, Leases]:
    return Leases(store._engine), Leases(store._engine)


def expire(store: Store) -> None:
    """As after the term of every lease."""
    with store._engine.begin() as db:
        db.exec_driver_sql("UPDATE leases SET expires_at = clock_timestamp() - interval '1 second'")


def acquired(leases: Leases, mission_id: str = "m") -> int | LeaseHolder:
    return leases.acquire(mission_id, "http://here:1", TERM_S)


def taken_over(leases: Leases) -> int | LeaseHolder:
    """The epoch once another edge's transaction has ended, which must have locked the lease."""
    with pytest.raises(sa.exc.OperationalError, match="lock timeout"):
        acquired(leases)
    # Each refusal takes the lock's limit of a second.
    for _ in range(int(PATIENCE_S)):
        try:
            return acquired(leases)
        except sa.exc.OperationalError as error:
            assert "lock timeout" in str(error)
    raise AssertionError("the lease stays locked")


def fence(db: sa.Connection, leases: Leases, epoch: int) -> None:
    """Within a transaction."""
    driver: Any = db.connection.driver_connection
    leases.fence(driver, {("m", epoch)})


def fenced(store: Store, leases: Leases, epoch: int) -> None:
    with store._engine.connect() as db:
        fence(db, leases, epoch)


def test_a_lease_is_taken_over_only_once_it_has_ended(store: Store, edges: tuple[Leases, Leases]) -> None:
    one, other = edges
    assert one.acquire("m", "http://one:1", TERM_S) == 1
    refused = acquired(other)
    assert isinstance(refused, LeaseHolder)
    assert refused.address == "http://one:1" and TERM_S - 60 < refused.left_s <= TERM_S
    assert one.lost([("m", 1)]) == set()
    expire(store)
    assert acquired(other) == 2
    assert isinstance(acquired(one), LeaseHolder)
    assert one.lost([("m", 1)]) == {("m", 1)}


def test_a_database_that_has_gone_back_lost_no_lease(store: Store, edges: tuple[Leases, Leases]) -> None:
    one, other = edges
    for _ in range(3):
        acquired(other, "old")
        expire(store)
        acquired(one, "old")
        expire(store)
    with store._engine.begin() as db:
        # A standby has an earlier owner of the one mission, and nothing of the other.
        db.exec_driver_sql("UPDATE leases SET epoch = 5 WHERE mission_id = 'old'")
    assert one.acquire("old", "http://here:1", TERM_S, 6) == 6
    expire(store)
    with store._engine.begin() as db:
        db.exec_driver_sql(f"UPDATE leases SET epoch = 5, owner = '{other._owner}'")
    assert one.lost([("old", 6), ("new", 4)]) == set()
    for mission_id, epoch in (("old", 6), ("new", 4)):
        # The leases are there again, and have ended.
        assert acquired(one, mission_id) == epoch
        expire(store)
        assert acquired(other, mission_id) == epoch + 1
    # Nor is a live lease of a smaller epoch taken from its owner.
    assert one.lost([("old", 6), ("new", 4)]) == {("old", 6), ("new", 4)}
    assert acquired(other, "old") == 7
    assert one.lost([("old", 60)]) == {("old", 60)}
    assert acquired(other, "old") == 7


def test_the_epoch_grows_when_another_owner_takes_the_lease_and_never_shrinks(
    store: Store, edges: tuple[Leases, Leases]
) -> None:
    one, other = edges
    epochs = []
    for leases in (one, one, other, other, one):
        epochs.append(acquired(leases))
        expire(store)
    assert epochs == [1, 1, 2, 2, 3]


def test_a_renewal_prolongs_what_has_not_ended_and_revives_nothing(store: Store, edges: tuple[Leases, Leases]) -> None:
    one, other = edges
    acquired(one, "ended")
    expire(store)
    assert (acquired(one, "a"), acquired(one, "b"), acquired(other, "others")) == (1, 1, 1)
    assert one.renew(TERM_S) == {"a": 1, "b": 1}
    assert acquired(other, "ended") == 2
    assert isinstance(acquired(other, "a"), LeaseHolder)


def test_a_released_lease_is_free_and_keeps_its_epoch(store: Store, edges: tuple[Leases, Leases]) -> None:
    one, other = edges
    acquired(one)
    expire(store)
    acquired(other)
    other.release()
    assert other.renew(TERM_S) == {}
    assert acquired(one) == 3


def test_of_two_edges_that_take_a_lease_at_once_exactly_one_gets_it(store: Store) -> None:
    edges = [Leases(store._engine) for _ in range(4)]
    start = threading.Barrier(len(edges))

    def take(leases: Leases, name: str) -> int | LeaseHolder:
        start.wait(60)
        return acquired(leases, name)

    with ThreadPoolExecutor(len(edges)) as pool:
        for attempt in range(20):
            answers = list(pool.map(take, edges, [f"m{attempt}"] * len(edges)))
            assert answers.count(1) == 1 and sum(isinstance(answer, LeaseHolder) for answer in answers) == 3


def test_the_fence_stops_whom_another_owner_has_followed(store: Store, edges: tuple[Leases, Leases]) -> None:
    one, other = edges
    acquired(one)
    fenced(store, one, 1)
    expire(store)
    # No other edge has taken the mission, so its waiting changes may still be written.
    fenced(store, one, 1)
    acquired(other)
    with pytest.raises(DivisionByZero):
        fenced(store, one, 1)
    assert one.lost({("m", 1)}) == {("m", 1)}
    expire(store)
    assert acquired(one) == 3
    # The mission in memory is of before the other's time.
    with pytest.raises(DivisionByZero):
        fenced(store, one, 1)
    assert one.lost({("m", 1)}) == {("m", 1)} and one.lost({("m", 3)}) == set()
    fenced(store, one, 3)


def test_a_lease_cannot_be_taken_over_in_the_midst_of_a_transaction(store: Store, edges: tuple[Leases, Leases]) -> None:
    one, other = edges
    acquired(one)
    expire(store)
    with store._engine.begin() as db:
        fence(db, one, 1)
        with pytest.raises(sa.exc.OperationalError, match="lock timeout"):
            acquired(other)
    assert acquired(other) == 2


def test_an_owner_that_stops_in_the_midst_of_a_transaction_does_not_keep_others_out_for_long(
    store: Store, edges: tuple[Leases, Leases]
) -> None:
    one, other = edges
    acquired(one)
    expire(store)
    with pytest.raises(sa.exc.DBAPIError, match="idle-in-transaction"), store._engine.begin() as db:
        fence(db, one, 1)
        assert taken_over(other) == 2
        db.exec_driver_sql("SELECT 1")


def test_an_owner_that_stops_in_the_midst_of_a_pipeline_does_not_keep_others_out_for_long(
    store: Store, edges: tuple[Leases, Leases]
) -> None:
    one, other = edges
    acquired(one)
    expire(store)
    connection = store._engine.raw_connection()
    db: Any = connection.driver_connection
    db.autocommit = True
    # As the writer is when it is paused between two messages.
    with pytest.raises(psycopg.OperationalError, match="closed the connection"), db.pipeline():
        db.execute("BEGIN")
        one.fence(db, {("m", 1)})
        assert taken_over(other) == 2
        db.execute("COMMIT")
    connection.invalidate()


async def test_a_transaction_of_a_lost_mission_writes_nothing(store: Store) -> None:
    assert store.leases is not None
    spec = MissionSpec()
    resolved = ResolvedSpec.of(spec, Settings())
    epochs = [acquired(store.leases, name) for name in ("m", "n")]
    assert epochs == [1, 1]
    expire(store)
    assert acquired(Leases(store._engine)) == 2
    writer = store.writer()
    with pytest.raises(LeaseLost, match="another edge has taken over m$"):
        await commit_changes(writer, [Made("n", spec, resolved, 1), Made("m", spec, resolved, 1)])
    assert store.missions() == []
    await commit_changes(writer, [Made("n", spec, resolved, 1)])
    assert (store.missions(), store.leases.unowned()) == (["n"], ["n"])
    other = Leases(store._engine)
    assert acquired(store.leases, "n") == 1
    assert isinstance(acquired(other, "n"), LeaseHolder)
    assert (store.leases.unowned(), other.unowned()) == (["n"], [])
    # Deletion ends the lease.
    await commit_changes(writer, [Deleted("n", 1)])
    assert acquired(other, "n") == 2
    writer.close()


async def test_a_stored_mission_is_unowned_for_all_but_its_owner_once_the_lease_ends(store: Store) -> None:
    assert store.leases is not None
    one, other, spec = store.leases, Leases(store._engine), MissionSpec()
    acquired(one, "n")
    writer = store.writer()
    await commit_changes(writer, [Made("n", spec, ResolvedSpec.of(spec, Settings()), 1)])
    writer.close()
    assert (one.unowned(), other.unowned()) == (["n"], [])
    expire(store)
    assert (one.unowned(), other.unowned()) == (["n"], ["n"])
    acquired(other, "n")
    assert (one.unowned(), other.unowned()) == ([], ["n"])


@contextmanager
def _emptied(url: str) -> Iterator[sa.Connection]:
    """The database without the tables; a connection to it."""
    engine = sa.create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    with engine.begin() as db:
        db.exec_driver_sql("DROP TABLE missions, checkpoints, journal, leases, alembic_version")
    with engine.connect() as db:
        yield db
    engine.dispose()


def test_an_empty_database_is_opened_once_the_edge_that_migrates_it_has_ended(postgres: str) -> None:
    Store(postgres).close()
    with _emptied(postgres) as edge:
        edge.exec_driver_sql(f"SELECT pg_advisory_lock({0x41494356})")
        edge.commit()
        with pytest.raises(StoreUnusable, match="another edge has migrated the database"):
            Store(postgres)
        edge.exec_driver_sql(f"SELECT pg_advisory_unlock({0x41494356})")
        edge.commit()
        with ThreadPoolExecutor(2) as pool:
            for store in pool.map(Store, [postgres] * 2):
                store.close()
        assert edge.exec_driver_sql("SELECT version_num FROM alembic_version").scalar() == SCHEMA
