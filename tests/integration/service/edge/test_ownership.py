"""Several edges on one PostgreSQL: a mission has one owner, which others name, follow, and cannot be overwritten by."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from service.edge.engine import Engine
from service.edge.ownership import LeasedOwnership
from service.storage.leases import Leases
from service.storage.store import Store
from shared.client.edge_client import EdgeClient
from tests.support.processes import serving_edge
from tests.support.stored_missions import fly, running, stored_decision
from tests.support.waiting import PATIENCE_S, Gate, until

Body = dict[str, Any]
Report = Callable[..., Body]
Start = Callable[..., tuple[httpx.Client, Engine]]

# No lease ends by itself while a test runs.
TERM_S = 300.0


@pytest.fixture
def database(postgres: str) -> Iterator[sa.Connection]:
    """A connection to the database, which is empty."""
    Store(postgres).close()
    engine = sa.create_engine(postgres.replace("postgresql://", "postgresql+psycopg://"), isolation_level="AUTOCOMMIT")
    with engine.connect() as db:
        db.exec_driver_sql("TRUNCATE leases, missions, checkpoints, journal")
        yield db
    engine.dispose()


@pytest.fixture
def start(postgres: str, database: sa.Connection) -> Iterator[Start]:
    """Starts an edge on the database; its address is that of nobody unless told."""
    with ExitStack() as stack:

        def started(name: str = "one", **settings: Any) -> tuple[httpx.Client, Engine]:
            given = {"lease_s": TERM_S, "advertise_url": f"http://{name}:8000", **settings}
            return stack.enter_context(running(postgres, **given))

        yield started


def leave(database: sa.Connection) -> None:
    """As after the term of every lease, in the database alone: the owners do not know."""
    database.exec_driver_sql("UPDATE leases SET expires_at = clock_timestamp() - interval '1 second'")


def mission(client: httpx.Client, mission_id: str = "test") -> Body:
    answer = client.get(f"/missions/{mission_id}")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def listed(client: httpx.Client) -> list[str]:
    return sorted(line["mission_id"] for line in client.get("/missions").json()["missions"])


def ownership(engine: Engine) -> LeasedOwnership:
    assert isinstance(engine.missions._ownership, LeasedOwnership)
    return engine.missions._ownership


def test_an_edge_names_the_owner_of_a_mission_and_records_nothing(start: Start, report: Report) -> None:
    one, _ = start()
    pending = fly(one, report, range(2))
    before = mission(one)
    other, _ = start("two")
    outcome = {"mission_id": "test", **pending[0]}
    refusals = [
        other.post("/decide", json=report(step=2, outcome=pending[0]), headers={"Idempotency-Key": "k"}),
        other.post("/decide/batch", json={"mission_id": "test", "step": 2, "uavs": [_uav(report(step=2))]}),
        other.post("/feedback", json=outcome),
        other.put("/missions/test", json={}),
        other.get("/missions/test"),
        other.get("/missions/test/attention"),
        other.delete("/missions/test"),
        other.post("/missions/test/guidance", json={"note": "hover"}),
    ]
    for refused in refusals:
        assert (refused.status_code, refused.json()["owner"]) == (421, "http://one:8000")
        assert refused.headers["Location"] == f"http://one:8000{refused.request.url.path}"
        assert 1 <= int(refused.headers["Retry-After"]) <= TERM_S
    assert mission(one) == before
    assert (listed(one), listed(other)) == (["test"], [])
    assert other.get("/missions/none").status_code == 404


def _uav(body: Body) -> Body:
    return {key: body[key] for key in ("uav_id", "position", "sensors")}


def test_a_decision_for_a_mission_of_nobody_takes_no_lease(
    start: Start, report: Report, database: sa.Connection
) -> None:
    (one, engine), (two, _) = (start(name, create_on_decide="off") for name in ("one", "two"))
    one.put("/missions/test", json={}).raise_for_status()
    for client in (one, two):
        refused = client.post("/decide", json=report(mission_id="tset"))
        assert refused.status_code == 404 and "PUT /missions/tset" in refused.text
    assert list(database.scalars(sa.text("SELECT mission_id FROM leases"))) == ["test"]
    # One that is being made has an owner before it is stored.
    ownership(engine).claim("new")
    for answer in (two.post("/decide", json=report(mission_id="new")), two.get("/missions/new")):
        assert (answer.status_code, answer.json()["owner"]) == (421, "http://one:8000")
    leave(database)
    assert two.post("/decide", json=report(mission_id="new")).status_code == 404
    assert two.post("/decide", json=report()).status_code == 200


def test_a_decision_that_comes_while_its_mission_is_made_waits_for_it(
    start: Start, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, engine = start(create_on_decide="off")
    acquire, gate = Leases.acquire, Gate()

    def slowly(self: Leases, *args: Any) -> Any:
        gate.wait()
        return acquire(self, *args)

    monkeypatch.setattr(Leases, "acquire", slowly)
    stored = engine.missions._store
    assert stored is not None
    share, came = stored.share, list[str]()

    async def sharing(mission_id: str, *args: Any) -> None:
        came.append(mission_id)
        await share(mission_id, *args)

    monkeypatch.setattr(stored, "share", sharing)
    with ThreadPoolExecutor(2) as pool, gate:
        made = pool.submit(client.put, "/missions/test", json={})
        until(lambda: gate.callers)
        before = len(came)
        decided = pool.submit(client.post, "/decide", json=report())
        until(lambda: len(came) > before)
        gate.open()
        assert (made.result().status_code, decided.result().status_code) == (200, 200)


def test_an_edge_takes_over_what_is_free_and_the_former_owner_writes_nothing(
    start: Start, report: Report, database: sa.Connection
) -> None:
    one, engine = start()
    pending = fly(one, report, range(2))
    leave(database)
    two, _ = start("two")
    fly(two, report, range(2, 4), pending)
    flown = mission(two)
    # The first does not know yet: by its own clock the lease is valid.
    assert ownership(engine).owns("test")
    late = one.post("/decide", json=report(step=9))
    assert (late.status_code, late.headers["Retry-After"]) == (503, "1"), late.text
    assert "another edge has taken over" in late.text
    # Now it does.
    refused = one.post("/feedback", json={"mission_id": "test", "decision_id": "0" * 32, "cost": 0.5})
    assert (refused.status_code, refused.json()["owner"]) == (421, "http://two:8000")
    assert mission(two) == flown
    leave(database)
    # What it reads is what the other wrote, not what it had in memory.
    assert mission(one) == flown


def test_an_outcome_a_note_and_a_deletion_of_a_former_owner_are_refused(
    start: Start, report: Report, database: sa.Connection
) -> None:
    requests: list[Callable[[httpx.Client, Body], httpx.Response]] = [
        lambda client, pending: client.post("/feedback", json={"mission_id": "test", **pending}),
        lambda client, pending: client.post("/feedback", json=pending),
        lambda client, _: client.post("/missions/test/guidance", json={"note": "hover"}),
        lambda client, _: client.delete("/missions/test"),
    ]
    edges = [start("one", mode="policy")[0], start("two", mode="policy")[0]]
    for turn, request in enumerate(requests):
        former, present = edges[turn % 2], edges[1 - turn % 2]
        pending = {
            "decision_id": stored_decision(former, report(step=turn))["decision_id"],
            "cost": 0.5,
            "failed": False,
        }
        leave(database)
        before = mission(present)
        refused = request(former, pending)
        assert (refused.status_code, "Retry-After" in refused.headers) == (503, True), refused.text
        assert mission(present) == before
        leave(database)


def test_other_missions_of_the_same_commit_are_written(
    start: Start, report: Report, database: sa.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, engine = start()
    for name in ("lost", "held"):
        stored_decision(one, report(mission_id=name))
    database.exec_driver_sql("UPDATE leases SET owner = 'another', epoch = epoch + 1 WHERE mission_id = 'lost'")
    gate, fence = Gate(), Leases.fence

    def late(self: Leases, *args: Any) -> None:
        gate.wait()
        fence(self, *args)

    monkeypatch.setattr(Leases, "fence", late)
    with ThreadPoolExecutor(3) as pool, gate:
        first = pool.submit(one.post, "/decide", json=report(step=1, mission_id="held"))
        until(lambda: gate.callers)
        both = [pool.submit(one.post, "/decide", json=report(step=2, mission_id=name)) for name in ("lost", "held")]
        until(lambda: len(engine.journal._commits._requests) == 3)  # type: ignore[union-attr]
        gate.open()
        assert first.result().json()["stored"] is True
        assert [answer.result().status_code for answer in both] == [503, 200]
        assert both[1].result().json()["stored"] is True
    assert not engine.journal.failing


def test_an_edge_whose_lease_has_ended_goes_on_where_nobody_else_had_the_mission(
    start: Start, report: Report, database: sa.Connection
) -> None:
    one, engine = start()
    fly(one, report, range(2))
    before = engine.missions.loaded
    leave(database)
    ownership(engine)._renew()
    assert not ownership(engine).owns("test")
    fly(one, report, range(2, 3))
    assert engine.missions.loaded == before
    assert database.exec_driver_sql("SELECT epoch FROM leases").scalars().all() == [1]


def test_a_renewal_drops_what_others_have_taken_and_lists_what_nobody_has(
    start: Start, report: Report, database: sa.Connection
) -> None:
    one, engine = start()
    two, _ = start("two")
    for name in ("a", "b"):
        stored_decision(one, report(mission_id=name))
    stored_decision(two, report(mission_id="c"))
    database.exec_driver_sql("UPDATE leases SET expires_at = clock_timestamp() WHERE mission_id <> 'a'")
    stored_decision(two, report(step=1, mission_id="b"))
    ownership(engine)._renew()
    until(lambda: listed(one) == ["a", "c"], lambda: listed(one))
    assert [held.mission_id for held in engine.missions.loaded] == ["a"]
    # One in memory counts once against the most that there may be.
    assert engine.missions.stored == ["c"]


def test_an_edge_that_ends_leaves_its_missions_to_others_at_once(start: Start, postgres: str, report: Report) -> None:
    with running(postgres, lease_s=TERM_S) as (one, _):
        fly(one, report, range(2))
        flown = mission(one)
    two, _ = start("two")
    assert listed(two) == ["test"]
    assert mission(two) == flown


def test_two_edges_that_are_asked_for_a_new_mission_at_once_make_one(start: Start, report: Report) -> None:
    edges = [start("one")[0], start("two")[0]]
    # FastAPI prepares its routes at the first request, and not in two threads at once.
    assert [listed(edge) for edge in edges] == [[], []]
    with ThreadPoolExecutor(8) as pool:
        for number in range(5):
            body = report(mission_id=f"m{number}")
            answers = list(pool.map(lambda edge: edge.post("/decide", json=body), edges * 4))  # noqa: B023
            assert {answer.status_code for answer in answers} == {200, 421}
            owner = next(a.json()["owner"] for a in answers if a.status_code == 421)
            assert mission(edges[owner == "http://two:8000"], f"m{number}")["decisions"] == 4


def test_a_mission_is_deleted_and_made_again_by_another_edge(start: Start, report: Report) -> None:
    one, _ = start()
    two, _ = start("two")
    fly(one, report, range(2))
    assert one.delete("/missions/test").status_code == 204
    assert two.get("/missions/test").status_code == 404
    assert two.put("/missions/test", json={"mode": "policy"}).status_code == 200
    assert one.get("/missions/test").status_code == 421
    assert one.delete("/missions/test").status_code == 421
    assert two.delete("/missions/test").status_code == 204
    fly(one, report, range(1))


def test_an_edge_without_its_database_is_not_ready_and_decides_no_longer_than_its_leases_last(
    start: Start, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, engine = start()
    fly(one, report, range(1))
    assert one.get("/readyz").status_code == 200

    def down(*_: object) -> None:
        raise sa.exc.OperationalError("", {}, Exception("the database is down"))

    owned = ownership(engine)
    with monkeypatch.context() as patch:
        patch.setattr(owned._leases, "acquire", down)
        # As after a term without a renewal.
        owned._renewed_at -= TERM_S
        owned._leased["test"].until -= TERM_S
        unready = one.get("/readyz")
        assert (unready.status_code, unready.json()["ready"]) == (503, False)
        refused = one.post("/decide", json=report(step=1))
        assert (refused.status_code, refused.headers["Retry-After"]) == (503, "1")
    owned._renew()
    assert one.get("/readyz").status_code == 200
    fly(one, report, range(1, 2))


def test_the_metrics_count_leases(start: Start, report: Report, database: sa.Connection) -> None:
    one, engine = start()
    fly(one, report, range(1))
    leave(database)
    two, second = start("two")
    fly(two, report, range(1, 2))
    for each in (engine, second):
        ownership(each)._renew()
    until(lambda: "aicvds_leases_lost_total 1.0" in one.get("/metrics").text)
    reported = two.get("/metrics").text
    assert "aicvds_leases 1.0" in reported and "aicvds_leases_taken_over_total 1.0" in reported


def test_a_client_follows_to_the_owner(start: Start, postgres: str, report: Report) -> None:
    settings = {"AICVDS_STORE": postgres, "AICVDS_MODE": "value", "AICVDS_LEASE_S": str(TERM_S)}
    with serving_edge(**settings) as (url, _):
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as owner:
            fly(owner, report, range(2))
        two, _ = start("two")
        assert two.get("/missions/test").headers["Location"] == f"{url}/missions/test"
        with EdgeClient(str(two.base_url), timeout_s=PATIENCE_S, attempts=1) as client:
            assert client.mission("test").decisions == 6


def test_an_edge_that_was_paused_past_its_term_writes_nothing(
    start: Start, postgres: str, report: Report, database: sa.Connection
) -> None:
    settings = {"AICVDS_STORE": postgres, "AICVDS_MODE": "value", "AICVDS_LEASE_S": "1"}
    with (
        serving_edge(**settings) as (url, paused),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as owner,
        ThreadPoolExecutor(2) as pool,
    ):
        pending = fly(owner, report, range(2))
        successor, _ = start("two")
        paused.send_signal(signal.SIGSTOP)
        try:
            outcome = {"mission_id": "test", **pending.pop(0)}
            waiting = [
                pool.submit(httpx.post, f"{url}{path}", json=body, timeout=PATIENCE_S)
                for path, body in (("/decide", report(step=9)), ("/feedback", outcome))
            ]
            until(lambda: successor.get("/missions/test").status_code == 200)
            fly(successor, report, range(2, 4), pending)
            flown = mission(successor)
        finally:
            paused.send_signal(signal.SIGCONT)
        for late in waiting:
            assert late.result().status_code in (421, 503), late.result().text
            assert "Retry-After" in late.result().headers
        assert owner.get("/missions/test").json()["owner"] == "http://two:8000"
        assert mission(successor) == flown
        # It was not recorded by the former owner.
        reported = successor.post("/feedback", json=outcome)
        assert reported.json()["result"] == "applied"


def test_no_client_is_sent_back_to_the_edge_that_it_asked(
    start: Start, report: Report, database: sa.Connection
) -> None:
    """An edge in place of a killed one has its address, and waits for the end of its leases."""
    killed, _ = start("one")
    stored_decision(killed, report())
    client, _ = start("one")
    refused = client.post("/decide", json=report(step=1))
    assert (refused.status_code, refused.headers["Retry-After"]) == (503, "1")
    leave(database)
    assert client.post("/decide", json=report(step=1)).status_code == 200
    assert mission(client)["decisions"] == 2
