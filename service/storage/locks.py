"""One edge has a store at a time: a SQLite file by its lock, a PostgreSQL database by an advisory lock and a term."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO

import sqlalchemy as sa

# Any number that no other program of the same database takes.
_ADVISORY_LOCK = 0x41494356
# How long a SQLite file is asked for that another process has, and how often.
_LAST_COMMIT_S, _RETRY_S = 1.0, 0.02


class StoreUnusable(Exception):
    """The store cannot be opened or written to; the text says why, and names no password."""


class FileLock:
    """Has a SQLite file as long as this process lives, however it ends, and the one that writes for it.

    Attributes:
        file: its own name: another edge may know it by a link.
        descriptor: of the lock. Who has it too keeps the file as long.

    Raises:
        StoreUnusable: another edge has it.
        OSError: there can be no lock file beside it.
    """

    def __init__(self, file: str) -> None:
        self.file = os.path.realpath(file)
        self._lock: IO[str] = open(f"{self.file}.lock", "w")  # noqa: SIM115
        self.descriptor = self._lock.fileno()
        # One that was killed may still have its last commit to end.
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
        """Let another edge have it."""
        self._lock.close()


class AdvisoryLock:
    """Has a PostgreSQL database as long as its connection lives.

    A connection that broke lets another edge in, unseen. So each edge begins a term of its own, a number in the
    database. One that takes the lock again in another's term knows missions as they were before it, and writes nothing.

    Raises:
        StoreUnusable: another edge has it.
        sqlalchemy.exc.SQLAlchemyError: it cannot be reached.
    """

    def __init__(self, engine: sa.Engine, terms: sa.Table) -> None:
        self._engine = engine
        self._terms = terms
        self._term: int | None = None
        self._connection = self._locked()

    def begin_term(self) -> None:
        """From now on this edge alone writes."""
        with self._connection.begin():
            made = sa.insert(self._terms).returning(self._terms.c.term)
            self._term = self._connection.scalar(made)

    @contextmanager
    def transaction(self) -> Iterator[sa.Connection]:
        """A transaction of the connection that has the lock, which is taken again where it was lost.

        Raises:
            StoreUnusable: another edge has, or had, the database meanwhile.
            sqlalchemy.exc.SQLAlchemyError: nothing was committed.
        """
        if self._connection.closed or self._connection.invalidated:
            self._connection = self._taken_again()
        with self._connection.begin():
            yield self._connection

    def close(self) -> None:
        """Let another edge have it."""
        _end(self._connection)

    def _taken_again(self) -> sa.Connection:
        connection = self._locked()
        try:
            with connection.begin():
                newest = connection.scalar(sa.select(sa.func.max(self._terms.c.term)))
            if newest != self._term:
                raise StoreUnusable("another edge has had it since: end this one, its missions are out of date")
        except BaseException:
            _end(connection)
            raise
        return connection

    def _locked(self) -> sa.Connection:
        connection = self._engine.connect()
        try:
            with connection.begin():
                taken = connection.scalar(sa.select(sa.func.pg_try_advisory_lock(_ADVISORY_LOCK)))
            if not taken:
                raise StoreUnusable(f"another edge uses the database {self._engine.url.database}")
        except BaseException:
            _end(connection)
            raise
        return connection


def _end(connection: sa.Connection) -> None:
    """End a connection and its locks; closed only, it would go back to the pool and keep them."""
    with suppress(sa.exc.SQLAlchemyError):
        connection.invalidate()
        connection.close()
