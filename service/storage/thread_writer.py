"""The writer of a PostgreSQL store: a separate thread."""

import asyncio
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from service.storage.leases import LeaseLost, Leases
from service.storage.operations import Change, Done
from service.storage.rows import Statement, Statements

if TYPE_CHECKING:
    # The driver is of the extra `postgres`.
    from psycopg import Connection


class ThreadWriter:
    """Writes from a thread: the database is already another process.

    A transaction of a mission that another edge has taken over ends with :class:`LeaseLost`.

    Args:
        statements: SQL for the database.
        leases: the missions' leases.
        engine: makes the connection, again after a failure.
    """

    def __init__(self, statements: Statements, leases: Leases, engine: sa.Engine) -> None:
        self._statements = statements
        self._leases = leases
        self._engine = engine
        self._connection: sa.PoolProxiedConnection | None = None
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        # A daemon: the end of the edge does not wait for a hanging database.
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """As :class:`Writer` says."""
        missions = {(change.mission_id, change.epoch) for change in changes}
        self._jobs.put(partial(self._write, missions, self._statements.of(changes), done, asyncio.get_running_loop()))

    def close(self) -> None:
        """As :class:`Writer` says."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
        self._disconnect()

    def _write(
        self,
        missions: set[tuple[str, int]],
        transaction: Sequence[Statement],
        done: Done,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        failure: Exception | None = None
        try:
            self._transact(missions, transaction)
        except Exception as error:
            failure = error
            if not isinstance(error, LeaseLost):
                self._disconnect()
        # The event loop is closed if the edge has ended meanwhile.
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(done, failure)

    def _transact(self, missions: set[tuple[str, int]], transaction: Sequence[Statement]) -> None:
        """Send one transaction in one round trip: the database waits for this edge only if it is paused in between."""
        from psycopg.errors import DivisionByZero

        # A connection of its own: one from the pool would be tried before each transaction.
        if self._connection is None:
            self._connection = self._engine.raw_connection()
        db: Connection[tuple[Any, ...]] = self._connection.driver_connection  # type: ignore[assignment]
        db.autocommit = True
        try:
            with db.pipeline():
                db.execute("BEGIN")
                self._leases.fence(db, missions)
                for sql, rows in transaction:
                    db.cursor().executemany(sql, rows)
                db.execute("COMMIT")
        except DivisionByZero:
            db.rollback()
            if lost := self._leases.lost(missions):
                raise LeaseLost(lost) from None
            # The database has gone back, and has the leases again.
            self._transact(missions, transaction)

    def _disconnect(self) -> None:
        """Close the connection, which may be broken or in the midst of a transaction."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.invalidate()
