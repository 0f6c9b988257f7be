"""The writer of a SQLite store: a process of its own at the other end of a socket."""

from __future__ import annotations

import asyncio
import logging
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress

import msgpack

from service.storage import sqlite_process
from service.storage.operations import Change
from service.storage.sql_statements import Statements
from service.storage.sqlite_process import LENGTH, framed
from service.storage.writer import Done, WriteFailed

log = logging.getLogger(__name__)

# The longest that a process may take to end when nothing is left to write.
_ENDS_S = 1.0
_READ_BYTES = 65_536


class ProcessWriter:
    """Has a process of its own write a SQLite file, and starts another where that ended.

    The event loop itself sends and receives. A thread would wait at every step of a commit for the interpreter, which
    the decisions have, and the decisions for the thread.

    Args:
        statements: SQL for SQLite.
        path: the file's.
        lock: descriptor of the lock on it. The process has it too, so that no other edge takes the file between a
            killed edge's end and its last commit.
    """

    def __init__(self, statements: Statements, path: str, lock: int) -> None:
        self._statements = statements
        self._path = path
        self._lock = lock
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._done: Done | None = None
        # What is being written, whether by a second process already, and what of it is still to be sent.
        self._frame = b""
        self._repeated = False
        self._outgoing = memoryview(b"")
        # Whether the socket takes no more for now.
        self._full = False
        self._incoming = bytearray()
        # So that it is ready when the first decision is; who cannot start it now tries again to write.
        with suppress(OSError):
            self._start()

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """As :class:`Writer` says."""
        self._frame = framed(self._statements.of(changes))
        self._repeated = False
        self._submit()
        self._done = done

    def close(self) -> None:
        """As :class:`Writer` says."""
        self._end()

    def _end(self) -> str:
        """What the process said in the end, where it had to say something."""
        said = ""
        if self._socket is not None:
            if self._loop is not None and not self._loop.is_closed():
                self._loop.remove_reader(self._socket.fileno())
                self._loop.remove_writer(self._socket.fileno())
            self._socket.close()
        if self._process is not None:
            # Then it ends by itself; where the disk hangs it keeps the lock, and ends later.
            with suppress(subprocess.TimeoutExpired):
                said = self._process.communicate(timeout=_ENDS_S)[1].decode(errors="replace").strip()
                said = said.splitlines()[-1] if said else f"exit code {self._process.returncode}"
        self._socket = self._process = self._loop = None
        self._full = False
        self._incoming.clear()
        return said

    def _submit(self) -> None:
        edge = self._socket or self._start()
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            self._loop.add_reader(edge.fileno(), self._receive)
        self._outgoing = memoryview(self._frame)
        self._send()

    def _start(self) -> socket.socket:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        with theirs:
            try:
                self._process = subprocess.Popen(
                    # Without the folder of that file in its path: some of its names are the standard library's too.
                    [sys.executable, "-P", sqlite_process.__file__, str(theirs.fileno()), self._path],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    # Not the edge's own: who waits for the end of that waits for a killed edge's last commit besides.
                    stderr=subprocess.PIPE,
                    pass_fds=(theirs.fileno(), self._lock),
                    # What a terminal sends to the edge is not for it.
                    start_new_session=True,
                )
            except OSError:
                ours.close()
                raise
        self._socket = ours
        return ours

    def _send(self) -> None:
        assert self._socket is not None and self._loop is not None
        try:
            with suppress(BlockingIOError):
                self._outgoing = self._outgoing[self._socket.send(self._outgoing) :]
        except OSError:
            # It has ended; whoever reads is told in a moment.
            self._outgoing = self._outgoing[:0]
        if self._outgoing:
            self._loop.add_writer(self._socket.fileno(), self._send)
            self._full = True
        elif self._full:
            self._loop.remove_writer(self._socket.fileno())
            self._full = False

    def _receive(self) -> None:
        assert self._socket is not None
        try:
            received = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received:
            self._ended()
            return
        self._incoming += received
        if len(self._incoming) < LENGTH.size:
            return
        end = LENGTH.size + LENGTH.unpack_from(self._incoming)[0]
        if len(self._incoming) < end:
            return
        why = msgpack.unpackb(self._incoming[LENGTH.size : end])
        del self._incoming[:end]
        self._frame, self._outgoing = b"", memoryview(b"")
        self._tell(None if why is None else WriteFailed(why))

    def _ended(self) -> None:
        said = self._end()
        log.warning("the process that writes the store has ended (%s): another begins", said)
        if self._done is None:
            return
        failed: Exception = WriteFailed(f"the process that writes it has ended ({said})")
        if not self._repeated:
            # Written or not, to write it again does no harm.
            self._repeated = True
            try:
                self._submit()
                return
            except OSError as error:
                failed = error
        self._tell(failed)

    def _tell(self, error: Exception | None) -> None:
        done, self._done = self._done, None
        if done is not None:
            done(error)
