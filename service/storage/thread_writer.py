"""The writer of a PostgreSQL store: a thread beside the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from queue import SimpleQueue

import sqlalchemy as sa

from service.storage.operations import Change
from service.storage.rows import Statement, Statements
from service.storage.writer import Done


class ThreadWriter:
    """Writes from a thread: the database is another process already.

    Args:
        statements: SQL for the database.
        begin: makes a transaction that is committed at its end.
    """

    def __init__(self, statements: Statements, begin: Callable[[], AbstractContextManager[sa.Connection]]) -> None:
        self._statements = statements
        self._begin = begin
        self._jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        # A daemon: the end of the edge does not wait for a database that hangs.
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """As :class:`Writer` says."""
        self._jobs.put(partial(self._write, self._statements.of(changes), done, asyncio.get_running_loop()))

    def close(self) -> None:
        """As :class:`Writer` says."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()

    def _write(self, transaction: Sequence[Statement], done: Done, loop: asyncio.AbstractEventLoop) -> None:
        failure: Exception | None = None
        try:
            with self._begin() as db:
                for sql, rows in transaction:
                    db.exec_driver_sql(sql, rows)
        except Exception as error:
            failure = error
        # The event loop is closed if the edge has ended meanwhile.
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(done, failure)
