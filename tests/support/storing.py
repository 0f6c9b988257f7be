"""A fast store for edges whose tests are not about stores, without a writing process."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import msgpack

from service.storage.locks import FileLock
from service.storage.operations import Change, Done, WriteFailed
from service.storage.rows import Statements
from service.storage.sqlite_writer import Database
from service.storage.store import Store


def empty_store(path: Path) -> Path:
    """Create an empty SQLite store, unless there is one; it is a copy, which needs no migrations."""
    if not path.exists():
        path.write_bytes(_empty())
    return path


@cache
def _empty() -> bytes:
    with TemporaryDirectory() as folder:
        made = Path(folder) / "made.db"
        Store(str(made)).close()
        return made.read_bytes()


class StoreHere(Store):
    """A SQLite store that is written in this process; tests/service/storage has the process that an edge starts."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(empty_store(path)))

    def writer(self) -> WriterHere:
        """A writer of the same statements."""
        assert isinstance(self._lock, FileLock)
        return WriterHere(Statements(self._engine.dialect), self._lock.file, self._epoch)


class WriterHere:
    """Commits as the writing process does, on the event loop."""

    def __init__(self, statements: Statements, path: str, epoch: int) -> None:
        self._statements, self._database = statements, Database(path, epoch, {})

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """See ``Writer``."""
        failed = self._database.commit(msgpack.unpackb(msgpack.packb(self._statements.of(changes))))
        asyncio.get_running_loop().call_soon(done, None if failed is None else WriteFailed(*failed))

    def close(self) -> None:
        """See ``Writer``."""
        self._database.close()
