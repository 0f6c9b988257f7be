"""The process that writes a SQLite store, so that a commit waits for no interpreter that decides, nor that for it.

Run by :class:`service.storage.process_writer.ProcessWriter`, which is at the other end of a socket. Each way goes
MessagePack, after its length in four bytes: a list of [SQL, rows], all of which is committed, or none; back nil, or why
it was not.

It ends, the last commit done, when the other end is closed, however the edge ended. It imports next to nothing, so
that it takes 17 MB and a twentieth of a second.
"""

from __future__ import annotations

import signal
import socket
import sqlite3
import struct
import sys
from contextlib import suppress
from typing import Any

import msgpack

LENGTH = struct.Struct("<I")
# Milliseconds that a transaction waits for another program's lock of the file.
BUSY_MS = 1000
# WAL, so that readers and the writer do not wait for each other; FULL, so that power may fail after a commit.
PRAGMAS = ("journal_mode=WAL", "synchronous=FULL", f"busy_timeout={BUSY_MS}")


def framed(message: Any) -> bytes:
    """A message with its length before it."""
    packed: bytes = msgpack.packb(message)
    return LENGTH.pack(len(packed)) + packed


def serve(edge: socket.socket, path: str) -> None:
    """Commit what the edge sends until it is gone."""
    database = Database(path)
    with edge.makefile("rb") as sent:
        while len(head := sent.read(LENGTH.size)) == LENGTH.size:
            (length,) = LENGTH.unpack(head)
            if len(transaction := sent.read(length)) < length:
                break
            edge.sendall(framed(database.commit(msgpack.unpackb(transaction))))
    database.close()


class Database:
    """A connection, opened when it is needed, and after each failure anew."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._db: sqlite3.Connection | None = None

    def commit(self, transaction: list[tuple[str, list[Any]]]) -> str | None:
        """Carry out all of it, or nothing and tell why."""
        try:
            db = self._db or self._opened()
            db.execute("BEGIN IMMEDIATE")
            for sql, rows in transaction:
                db.executemany(sql, rows)
            db.execute("COMMIT")
        except Exception as error:
            self.close()
            return str(error) or type(error).__name__
        return None

    def close(self) -> None:
        """Give up what is not committed."""
        if self._db is not None:
            with suppress(sqlite3.Error):
                self._db.close()
            self._db = None

    def _opened(self) -> sqlite3.Connection:
        self._db = sqlite3.connect(self._path, isolation_level=None)
        for pragma in PRAGMAS:
            self._db.execute(f"PRAGMA {pragma}")
        return self._db


if __name__ == "__main__":
    # A terminal, or a service manager, sends these to the edge and to whatever it started.
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    with socket.socket(fileno=int(sys.argv[1])) as other, suppress(ConnectionError):
        serve(other, sys.argv[2])
