"""The process that writes a SQLite store, so that commits and decisions do not wait for the same interpreter.

:class:`service.storage.process_writer.ProcessWriter` runs it and is connected by a socket. Each message is MessagePack
after its length in four bytes. A request is a transaction, a list of [SQL, rows]. Its answer is nil, or the failure as
the arguments of :class:`service.storage.operations.WriteFailed`.

The process ends when the socket is closed, after its last commit, even if the edge was killed. It imports very little,
so that it takes 17 MB and starts in a twentieth of a second.
"""

import ctypes
import os
import select
import signal
import socket
import sqlite3
import struct
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import quote

import msgpack

LENGTH = struct.Struct("<I")
# The numbers of Linux's system call `sched_setattr`, for which Python has no function, its argument, and the shortest
# slice that Linux grants, in ns.
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_SCHED_ATTRIBUTES, _SLICE_NS = struct.Struct("IIQiIQQQ"), 100_000
# Milliseconds that a transaction waits while another program has the file locked.
BUSY_MS = 1000
# WAL: readers and the writer do not wait for each other. FULL: a commit survives a power failure.
PRAGMAS = ("journal_mode=WAL", "synchronous=FULL", f"busy_timeout={BUSY_MS}")
# A look at the log's times makes the next commit a quarter slower: the file system then writes exact times (multigrain
# timestamps, since Linux 6.13). So the log is looked at after this pause, and in a busy store after this time.
_PAUSE_MS, _LOOK_S = 3, 0.05


def framed(message: Any) -> bytes:
    """A message in MessagePack, after its length."""
    packed: bytes = msgpack.packb(message)
    return LENGTH.pack(len(packed)) + packed


# The device, the inode and the number of names of a file; empty if there is none.
Identity = tuple[int, ...]
# The same, and a file's size and time of change.
Facts = tuple[Identity, tuple[int, int]]


def identity(file: str) -> Identity:
    """The identity of a file."""
    return _facts(file)[0]


def _facts(file: str) -> Facts:
    try:
        # A link in the file's place is another file, too: the next edge opens what it points to.
        found = os.lstat(file)
    except OSError:
        return (), (0, 0)
    return (found.st_dev, found.st_ino, found.st_nlink), (found.st_size, found.st_mtime_ns)


def shorten_slice() -> None:
    """Ask Linux (from 6.12 on) for short time slices: the shorter the slice, the sooner a process that wakes up runs.

    Where threads of an LLM use all cores, a commit of a tenth of a millisecond else waits for their longer slices.
    """
    number = _SCHED_SETATTR.get(os.uname().machine)
    if sys.platform == "linux" and number is not None and os.sched_getscheduler(0) == os.SCHED_OTHER:
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        ordinary = _SCHED_ATTRIBUTES.pack(_SCHED_ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, _SLICE_NS, 0, 0)
        ctypes.CDLL(None).syscall(number, 0, ordinary, 0)


_CHANGED = "another program has changed the store's file: restart the edge"


class Displaced(Exception):
    """A file of the store was deleted, replaced or hard-linked, and may be put back."""


class Changed(Exception):
    """Another program has written the store: this edge must not write it any more."""


def serve(edge: socket.socket, path: str, epoch: int, known: Mapping[str, Identity]) -> None:
    """Commit the transactions that the edge sends, until it closes the socket; arguments as :class:`Database`."""
    database, waiting = Database(path, epoch, known), select.poll()
    waiting.register(edge, select.POLLIN)
    with edge.makefile("rb") as sent:
        while True:
            if not waiting.poll(_PAUSE_MS):
                database.look()
            if len(head := sent.read(LENGTH.size)) < LENGTH.size:
                break
            (length,) = LENGTH.unpack(head)
            if len(transaction := sent.read(length)) < length:
                break
            edge.sendall(framed(database.commit(msgpack.unpackb(transaction))))
    database.close()


class Database:
    """A connection that opens at its first transaction, and again after each failure.

    A commit to a deleted file would be lost when the edge ends. So a commit fails if the file, its lock file or its
    write-ahead log was deleted, replaced or given another name, or if another program has written any of them. Of a
    busy store the log is looked at every 50 ms only.

    Args:
        path: of the SQLite file, which must exist.
        epoch: of the edge that owns the file; the file has it as its ``user_version``.
        known: the identity of the file and of its lock's file, as the edge opened them, by path.
    """

    def __init__(self, path: str, epoch: int, known: Mapping[str, Identity]) -> None:
        self._path = path
        self._epoch = epoch
        self._known = known
        self._db: sqlite3.Connection | None = None
        # The version of the file's content, which changes when another program writes it.
        self._version: int | None = None
        # The file, and after a commit its write-ahead log, as this connection left them at the last look.
        self._left: list[Facts] = []
        self._looked, self._looked_at = False, 0.0

    def commit(self, transaction: list[tuple[str, list[Any]]]) -> tuple[str, bool, bool] | None:
        """Commit a transaction; returns None, or the arguments of ``WriteFailed`` if nothing of it was committed."""
        try:
            db = self._db or self._open()
            if self._looked and self._inspect(db) != self._left:
                raise Changed(_CHANGED)
            db.execute("BEGIN IMMEDIATE")
            if (version := db.execute("PRAGMA data_version").fetchone()[0]) != self._version:
                if db.execute("PRAGMA user_version").fetchone()[0] != self._epoch:
                    raise Changed("another edge has opened the store's file: end one of them, and restart the other")
                if self._version is not None:
                    raise Changed(_CHANGED)
                self._version = version
            for sql, rows in transaction:
                db.executemany(sql, rows)
            db.execute("COMMIT")
            self._looked = False
            self._check_known()
            if time.monotonic() > self._looked_at + _LOOK_S:
                self._look(db)
        except Exception as error:
            self.close()
            # Damage is of this class itself; a full disk or a lock is of a class below it.
            final = isinstance(error, Changed) or type(error) is sqlite3.DatabaseError
            return str(error) or type(error).__name__, final or isinstance(error, Displaced), final
        return None

    def look(self) -> None:
        """Note how the last commit has left the file and its log, for the next one to compare."""
        if self._db is not None and not self._looked:
            try:
                self._look(self._db)
            except (Displaced, sqlite3.Error):
                # The next commit opens the file again, if it is the same.
                self.close()

    def close(self) -> None:
        """Close the connection; an open transaction is rolled back."""
        if self._db is not None:
            with suppress(sqlite3.Error):
                self._db.close()
            self._db = None
        self._left, self._looked, self._version = [], False, None

    def _look(self, db: sqlite3.Connection) -> None:
        self._left, self._looked, self._looked_at = self._inspect(db), True, time.monotonic()

    def _inspect(self, db: sqlite3.Connection) -> list[Facts]:
        """The file and its log; raises ``Displaced`` if the next edge will not open the same ones."""
        log = f"{self._path}-wal"
        found = [_facts(self._path), _facts(log)]
        if found[0][0] != self._left[0][0]:
            raise _displaced(self._path)
        if not found[1][0] or (len(self._left) > 1 and found[1][0] != self._left[1][0]):
            # The commits of the log that was deleted go into the file, and the next transaction begins another log.
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            raise _displaced(log)
        return found

    def _check_known(self) -> None:
        for file, known in self._known.items():
            if identity(file) != known:
                raise _displaced(file)

    def _open(self) -> sqlite3.Connection:
        self._check_known()
        # It must not make a new file.
        self._db = sqlite3.connect(f"file:{quote(self._path)}?mode=rw", uri=True, isolation_level=None)
        for pragma in PRAGMAS:
            self._db.execute(f"PRAGMA {pragma}")
        self._left = [_facts(self._path)]
        return self._db


def _displaced(file: str) -> Displaced:
    name = os.path.basename(file)
    return Displaced(f"{name} was deleted, replaced or hard-linked while the edge ran: undo that, or restart the edge")


if __name__ == "__main__":
    shorten_slice()
    # A terminal or a service manager sends these signals to the edge and to its children.
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    with socket.socket(fileno=int(sys.argv[1])) as other, suppress(ConnectionError):
        opened = {
            file: tuple(map(int, known.split(":"))) for file, known in zip(sys.argv[4::2], sys.argv[5::2], strict=True)
        }
        serve(other, sys.argv[2], int(sys.argv[3]), opened)
