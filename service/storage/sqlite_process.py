"""The process that writes a SQLite store, so that commits and decisions do not wait for the same interpreter.

:class:`service.storage.process_writer.ProcessWriter` runs it and is connected by a socket. Each message is MessagePack
after its length in four bytes. A request is a transaction, a list of [SQL, rows]. Its answer is nil, or the reason of
the failure.

The process ends when the socket is closed, after its last commit, even if the edge was killed. It imports very little,
so that it takes 17 MB and starts in a twentieth of a second.
"""

import os
import signal
import socket
import sqlite3
import struct
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import quote

import msgpack

LENGTH = struct.Struct("<I")
# In the reason of a failure that lasts until the edge ends, unless the file is put back.
REPLACED = "was deleted or replaced while the edge ran"
# Milliseconds that a transaction waits while another program has the file locked.
BUSY_MS = 1000
# WAL: readers and the writer do not wait for each other. FULL: a commit survives a power failure.
PRAGMAS = ("journal_mode=WAL", "synchronous=FULL", f"busy_timeout={BUSY_MS}")


def framed(message: Any) -> bytes:
    """A message in MessagePack, after its length."""
    packed: bytes = msgpack.packb(message)
    return LENGTH.pack(len(packed)) + packed


def identity(file: str) -> str:
    """The device and the inode of a file; empty if there is none."""
    try:
        found = os.stat(file)
    except OSError:
        return ""
    return f"{found.st_dev}:{found.st_ino}"


def serve(edge: socket.socket, path: str, known: Mapping[str, str]) -> None:
    """Commit the transactions that the edge sends, until it closes the socket; arguments as :class:`Database`."""
    database = Database(path, known)
    with edge.makefile("rb") as sent:
        while len(head := sent.read(LENGTH.size)) == LENGTH.size:
            (length,) = LENGTH.unpack(head)
            if len(transaction := sent.read(length)) < length:
                break
            edge.sendall(framed(database.commit(msgpack.unpackb(transaction))))
    database.close()


class Database:
    """A connection that opens at its first transaction, and again after each failure.

    A commit to a deleted file would be lost when the edge ends. So a commit fails if the file, its lock file or its
    write-ahead log was deleted or replaced.

    Args:
        path: of the SQLite file, which must exist.
        known: the identity of the file and of its lock's file, as the edge opened them, by path.
    """

    def __init__(self, path: str, known: Mapping[str, str]) -> None:
        self._path = path
        self._known = known
        self._db: sqlite3.Connection | None = None
        # The identity of this connection's write-ahead log.
        self._log = ""

    def commit(self, transaction: list[tuple[str, list[Any]]]) -> str | None:
        """Commit a transaction; returns None, or the reason why nothing of it was committed."""
        try:
            db = self._db or self._open()
            db.execute("BEGIN IMMEDIATE")
            for sql, rows in transaction:
                db.executemany(sql, rows)
            db.execute("COMMIT")
            self._check(db)
        except Exception as error:
            self.close()
            return str(error) or type(error).__name__
        return None

    def close(self) -> None:
        """Close the connection; an open transaction is rolled back."""
        if self._db is not None:
            with suppress(sqlite3.Error):
                self._db.close()
            self._db = None
        self._log = ""

    def _check(self, db: sqlite3.Connection) -> None:
        """Raises ``OSError`` if the commit is in a file that the next edge will not open."""
        self._check_known()
        log = identity(f"{self._path}-wal")
        self._log = self._log or log
        if not log or log != self._log:
            # The commits of the log that was deleted go into the file, and the next transaction begins another log.
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            raise OSError(f"{self._path}-wal {REPLACED}")

    def _check_known(self) -> None:
        for file, known in self._known.items():
            if identity(file) != known:
                raise OSError(f"{file} {REPLACED}: put it back, or restart the edge")

    def _open(self) -> sqlite3.Connection:
        self._check_known()
        # It must not make a new file.
        self._db = sqlite3.connect(f"file:{quote(self._path)}?mode=rw", uri=True, isolation_level=None)
        for pragma in PRAGMAS:
            self._db.execute(f"PRAGMA {pragma}")
        return self._db


if __name__ == "__main__":
    # A terminal or a service manager sends these signals to the edge and to its children.
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    with socket.socket(fileno=int(sys.argv[1])) as other, suppress(ConnectionError):
        serve(other, sys.argv[2], dict(zip(sys.argv[3::2], sys.argv[4::2], strict=True)))
