"""Leases: ownership of the missions in a PostgreSQL store that several edges share.

A lease has an owner, an epoch and an end. The owner is one run of an edge's process. The epoch grows when another owner
takes the lease, and never shrinks. Only the database's clock counts. The transaction that writes the journal locks the
leases of its missions and compares their epochs (:meth:`Leases.fence`): an owner that was paused or disconnected cannot
write after its successor, whatever its own clock says. A transaction that locks a lease waits for its edge only where
that is paused between two messages, and ends then by the store's time limits.
"""

import uuid
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

if TYPE_CHECKING:
    # The driver is of the extra `postgres`.
    from psycopg import Connection

# clock_timestamp() gives the time after the row is locked; the statement may have waited for the lock.
_ACQUIRE = sa.text("""
    INSERT INTO leases AS held (mission_id, owner, address, epoch, expires_at)
    VALUES (:mission_id, :owner, :address, :known, clock_timestamp() + :term_s * interval '1 second')
    ON CONFLICT (mission_id) DO UPDATE
    SET owner = excluded.owner, address = excluded.address,
        epoch = greatest(held.epoch + (held.owner <> excluded.owner)::int, excluded.epoch),
        expires_at = clock_timestamp() + :term_s * interval '1 second'
    WHERE held.owner = excluded.owner OR held.expires_at <= clock_timestamp()
    RETURNING epoch
""")
_OWNER = sa.text("""
    SELECT owner, address, extract(epoch FROM expires_at - clock_timestamp())::float8 AS left_s
    FROM leases WHERE mission_id = :mission_id
""")
# Rows are locked in the order of their keys, as the fence does: two transactions never wait for each other.
_HELD = """
    WITH held AS (
        SELECT mission_id FROM leases WHERE owner = :owner AND expires_at > clock_timestamp()
        ORDER BY mission_id FOR UPDATE
    )
"""
_RENEW = sa.text(f"""{_HELD}
    UPDATE leases SET expires_at = clock_timestamp() + :term_s * interval '1 second'
    FROM held WHERE leases.mission_id = held.mission_id
    RETURNING leases.mission_id, leases.epoch
""")
_RELEASE = sa.text(f"""{_HELD}
    UPDATE leases SET expires_at = clock_timestamp() FROM held WHERE leases.mission_id = held.mission_id
""")
_UNOWNED = sa.text("""
    SELECT mission_id FROM missions WHERE NOT EXISTS (
        SELECT 1 FROM leases
        WHERE leases.mission_id = missions.mission_id AND owner <> :owner AND expires_at > clock_timestamp()
    )
""")
_STARTED = sa.text("SELECT pg_postmaster_start_time()")
# Fails by a division by zero unless every lease exists; the statements sent after it then have no effect.
_FENCE = """
    SELECT 1 / (count(*) = %s)::int FROM (
        SELECT FROM leases
        JOIN unnest(%s::text[], %s::bigint[]) AS written (mission_id, epoch) USING (mission_id, epoch)
        WHERE owner = %s ORDER BY mission_id FOR SHARE OF leases
    ) AS held
"""
_NEWER = sa.text("""
    SELECT written.mission_id, written.epoch FROM leases
    JOIN unnest(CAST(:names AS text[]), CAST(:epochs AS bigint[])) AS written (mission_id, epoch) USING (mission_id)
    WHERE leases.epoch > written.epoch
    OR owner <> :owner AND (leases.epoch = written.epoch OR expires_at > clock_timestamp())
""")
_RESTORE = sa.text("""
    INSERT INTO leases AS held (mission_id, owner, address, epoch, expires_at)
    SELECT mission_id, :owner, '', epoch, clock_timestamp()
    FROM unnest(CAST(:names AS text[]), CAST(:epochs AS bigint[])) AS known (mission_id, epoch) ORDER BY mission_id
    ON CONFLICT (mission_id) DO UPDATE
    SET owner = excluded.owner, address = '', epoch = excluded.epoch, expires_at = clock_timestamp()
    WHERE held.epoch < excluded.epoch AND (held.owner = excluded.owner OR held.expires_at <= clock_timestamp())
""")


class LeaseLost(Exception):
    """Nothing of a transaction was written, because other owners took over missions of it.

    Attributes:
        lost: their IDs, with the epochs under which they were to be written.
    """

    def __init__(self, lost: Collection[tuple[str, int]]) -> None:
        super().__init__(f"another edge has taken over {', '.join(sorted(mission_id for mission_id, _ in lost))}")
        self.lost = frozenset(lost)


@dataclass(frozen=True, slots=True)
class LeaseHolder:
    """Another edge that owns a mission: its address, and the seconds until its lease ends unless it is renewed."""

    address: str
    left_s: float


class Leases:
    """The leases of one owner; its methods may be called from any thread, and wait for the database.

    Every method raises ``sqlalchemy.exc.SQLAlchemyError`` if the database fails.
    """

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._owner = str(uuid.uuid4())

    def acquire(self, mission_id: str, address: str, term_s: float, known: int = 1) -> int | LeaseHolder:
        """Take a lease that is free or has ended; returns its epoch, or its holder.

        An owner whose lease has ended gets it again with the same epoch, unless another owner has had it.

        Args:
            address: where clients reach this edge.
            term_s: seconds until the lease ends.
            known: the epoch of this owner's last lease, which a database that has gone back may lack.
        """
        new = {"mission_id": mission_id, "owner": self._owner, "address": address, "term_s": term_s, "known": known}
        with self._autocommit() as db:
            epoch = db.scalar(_ACQUIRE, new)
            if epoch is not None:
                return int(epoch)
            row = db.execute(_OWNER, {"mission_id": mission_id}).one()
        return LeaseHolder(row.address, max(0.0, row.left_s))

    def owner(self, mission_id: str) -> LeaseHolder | None:
        """The other edge that has the mission's lease, whether the mission is stored or not; None if there is none."""
        with self._autocommit() as db:
            row = db.execute(_OWNER, {"mission_id": mission_id}).first()
        if row is None or row.owner == self._owner or row.left_s <= 0:
            return None
        return LeaseHolder(row.address, row.left_s)

    def renew(self, term_s: float) -> dict[str, int]:
        """Prolong every lease of this owner that has not ended; returns their missions with their epochs."""
        with self._autocommit() as db:
            rows = db.execute(_RENEW, {"owner": self._owner, "term_s": term_s}).all()
        return {row.mission_id: row.epoch for row in rows}

    def started(self) -> object:
        """When the database's process began: another database, or one that was restored, has another time."""
        with self._autocommit() as db:
            return db.scalar(_STARTED)

    def release(self) -> None:
        """End every lease of this owner now; the epochs stay."""
        with self._autocommit() as db:
            db.execute(_RELEASE, {"owner": self._owner})

    def unowned(self) -> list[str]:
        """The IDs of all stored missions that no other edge owns."""
        with self._autocommit() as db:
            return list(db.scalars(_UNOWNED, {"owner": self._owner}))

    def fence(self, db: "Connection[tuple[Any, ...]]", missions: Collection[tuple[str, int]]) -> None:
        """Keep the missions' leases from being taken over until the transaction ends.

        An ended lease is no obstacle unless another owner has taken it. If another owner has one of them, or has had it
        since that epoch, the statement and the transaction fail by a division by zero. In a pipeline nothing waits for
        its answer.

        Args:
            missions: IDs and epochs.
        """
        names, epochs = zip(*missions, strict=True)
        db.execute(_FENCE, (len(missions), list(names), list(epochs), self._owner))

    def lost(self, missions: Collection[tuple[str, int]]) -> set[tuple[str, int]]:
        """The missions and epochs whose lease another owner has taken over.

        Where a lease is missing or has a smaller epoch, the database has gone back: such leases are made anew, ended.
        """
        names, epochs = zip(*missions, strict=True)
        written = {"names": list(names), "epochs": list(epochs), "owner": self._owner}
        with self._autocommit() as db:
            lost = {(row.mission_id, row.epoch) for row in db.execute(_NEWER, written)}
            if not lost:
                db.execute(_RESTORE, written)
        return lost

    @contextmanager
    def _autocommit(self) -> Iterator[sa.Connection]:
        """A connection on which each statement is a transaction.

        An edge that is paused between a statement and its commit would keep the rows locked from its successors.
        """
        with self._engine.connect() as db:
            yield db.execution_options(isolation_level="AUTOCOMMIT")
