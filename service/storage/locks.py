"""Locks: a store belongs to one edge at a time.

A SQLite file has a lock file beside it, a PostgreSQL database an advisory lock and a fencing term.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO

import sqlalchemy as sa

# An arbitrary key, which no other program of the same database may use.
_ADVISORY_LOCK = 0x41494356
# How long a lock that another process has is tried, and how often.
_LAST_COMMIT_S, _RETRY_S = 1.0, 0.02


class StoreUnusable(Exception):
    """The store cannot be opened or written; the text gives the reason, without a password."""


class FileLock:
    """The lock of a SQLite file: it lasts as long as this process or the process that writes the file.

    Attributes:
        file: the real path; another edge may use a symbolic link to it.
        descriptor: of the lock file. A process that inherits it shares the lock.

    Raises:
        StoreUnusable: another edge has the lock.
        OSError: the lock file cannot be made.
    """

    def __init__(self, file: str) -> None:
        self.file = os.path.realpath(file)
        self._lock: IO[str] = open(f"{self.file}.lock", "w")  # noqa: SIM115
        self.descriptor = self._lock.fileno()
        # The writer of a killed edge may still have its last commit to end.
        ends = time.monotonic() + _LAST_COMMIT_S
        while True:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() >= ends:
                    self._lock.close()
                    raise StoreUnusable(f"another edge uses {self.file}") from None
            time.sleep(_RETRY_S)

    def close(self) -> None:
        """Release the lock."""
        self._lock.close()


class AdvisoryLock:
    """The lock of a PostgreSQL database: it lasts as long as its connection.

    When the connection breaks, another edge can take the lock unnoticed. Therefore each edge begins a fencing term, a
    number in the database. An edge that finds a later term than its own has outdated missions, and writes nothing.

    Raises:
        StoreUnusable: another edge has the lock.
        sqlalchemy.exc.SQLAlchemyError: the database cannot be reached.
    """

    def __init__(self, engine: sa.Engine, terms: sa.Table) -> None:
        self._engine = engine
        self._terms = terms
        self._term: int | None = None
        self._connection = self._connect_and_lock()

    def begin_term(self) -> None:
        """Begin a fencing term: from now on only this edge writes."""
        with self._connection.begin():
            inserted = sa.insert(self._terms).returning(self._terms.c.term)
            self._term = self._connection.scalar(inserted)

    @contextmanager
    def transaction(self) -> Iterator[sa.Connection]:
        """A transaction of the connection that has the lock; a lost lock is taken again first.

        Raises:
            StoreUnusable: another edge has the lock, or had it meanwhile.
            sqlalchemy.exc.SQLAlchemyError: nothing was committed.
        """
        if self._connection.closed or self._connection.invalidated:
            self._connection = self._lock_again()
        with self._connection.begin():
            yield self._connection

    def close(self) -> None:
        """Release the lock."""
        _disconnect(self._connection)

    def _lock_again(self) -> sa.Connection:
        connection = self._connect_and_lock()
        try:
            with connection.begin():
                newest = connection.scalar(sa.select(sa.func.max(self._terms.c.term)))
                if newest != self._term:
                    # PostgreSQL takes a moment to notice that a connection has ended, and keeps its lock until then.
                    connection.scalar(sa.select(sa.func.pg_advisory_unlock(_ADVISORY_LOCK)))
            if newest != self._term:
                raise StoreUnusable("another edge has had it since: end this one, its missions are out of date")
        except BaseException:
            _disconnect(connection)
            raise
        return connection

    def _connect_and_lock(self) -> sa.Connection:
        connection = self._engine.connect()
        try:
            with connection.begin():
                locked = connection.scalar(sa.select(sa.func.pg_try_advisory_lock(_ADVISORY_LOCK)))
            if not locked:
                raise StoreUnusable(f"another edge uses the database {self._engine.url.database}")
        except BaseException:
            _disconnect(connection)
            raise
        return connection


def _disconnect(connection: sa.Connection) -> None:
    """End a connection with its locks; a connection that is only closed returns to the pool and keeps them."""
    with suppress(sa.exc.SQLAlchemyError):
        connection.invalidate()
        connection.close()
