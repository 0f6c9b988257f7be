"""The writer of a SQLite store: a separate process, connected by a socket."""

import asyncio
import logging
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress

import msgpack

from service.storage import sqlite_writer
from service.storage.operations import Change, Done, WriteFailed
from service.storage.rows import PACK_BYTES, Statements
from service.storage.sqlite_writer import LENGTH, identity

log = logging.getLogger(__name__)

# The longest wait for an idle process to exit.
EXIT_S = 1.0
_READ_BYTES = 65_536


class ProcessWriter:
    """Starts a process that writes a SQLite file, and another one when that process ends.

    The event loop itself sends and receives. A thread and the decisions would wait for each other's interpreter lock at
    every step of a commit.

    Args:
        statements: SQL for SQLite.
        path: of the file.
        locks: descriptors of the file's locks. The process inherits them, so that no other edge takes the file between
            the end of a killed edge and that edge's last commit.
        epoch: of the edge that owns the file.
    """

    def __init__(self, statements: Statements, path: str, locks: Sequence[int], epoch: int) -> None:
        self._statements = statements
        self._path = path
        self._locks = locks
        self._epoch = epoch
        # The failure after which nothing is written any more.
        self._final: WriteFailed | None = None
        # Another writer, after this one was killed, has to find the same files.
        self._known = {file: known for file in (path, f"{path}.lock") if (known := identity(file))}
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        # Set while the event loop reads the socket.
        self._loop: asyncio.AbstractEventLoop | None = None
        # Called when the current transaction has ended; None without one.
        self._done: Done | None = None
        # The current transaction, whether a second process is already writing it, and its unsent rest.
        self._frame = b""
        self._repeated = False
        self._outgoing = memoryview(b"")
        # Whether the event loop waits until the socket takes more.
        self._full = False
        self._incoming = bytearray()
        # The process is ready before the first decision. If it cannot start now, `write` tries again.
        with suppress(OSError):
            self._start()

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """As :class:`Writer` says."""
        if self._final is not None:
            # Raised again and again, one exception would collect the frames of each time.
            raise self._final.with_traceback(None)
        transaction = msgpack.packb(self._statements.of(changes), buf_size=PACK_BYTES)
        self._frame = LENGTH.pack(len(transaction)) + transaction
        self._repeated = False
        self._submit()
        self._done = done

    def close(self) -> None:
        """As :class:`Writer` says."""
        self._end()

    def _end(self) -> str:
        """End the process, and return the last line that it wrote to stderr, or its exit code."""
        message = ""
        if self._socket is not None:
            if self._loop is not None and not self._loop.is_closed():
                self._loop.remove_reader(self._socket.fileno())
                self._loop.remove_writer(self._socket.fileno())
            self._socket.close()
        if self._process is not None:
            # The process ends when its socket is closed. If the disk hangs, it ends later and has the lock until then.
            with suppress(subprocess.TimeoutExpired):
                message = self._process.communicate(timeout=EXIT_S)[1].decode(errors="replace").strip()
                message = message.splitlines()[-1] if message else f"exit code {self._process.returncode}"
        self._socket = self._process = self._loop = None
        self._full = False
        self._incoming.clear()
        return message

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
        arguments = [self._path, str(self._epoch)]
        for file, known in self._known.items():
            arguments += [file, ":".join(map(str, known))]
        with theirs:
            try:
                self._process = subprocess.Popen(
                    # -P keeps the script's folder out of its path: some modules there have names of standard ones.
                    [sys.executable, "-P", sqlite_writer.__file__, str(theirs.fileno()), *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    # With the edge's own stderr, a reader of the edge's log would wait for a killed edge's last commit.
                    stderr=subprocess.PIPE,
                    pass_fds=(theirs.fileno(), *self._locks),
                    # A terminal's signals are for the edge, not for this process.
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
            # The process has ended; `_receive` finds the end of the stream next.
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
            self._restart()
            return
        self._incoming += received
        if len(self._incoming) < LENGTH.size:
            return
        end = LENGTH.size + LENGTH.unpack_from(self._incoming)[0]
        if len(self._incoming) < end:
            return
        answer = msgpack.unpackb(self._incoming[LENGTH.size : end])
        del self._incoming[:end]
        self._frame, self._outgoing = b"", memoryview(b"")
        failure = None if answer is None else WriteFailed(*answer)
        if failure is not None and failure.final:
            self._final = failure
        self._report(failure)

    def _restart(self) -> None:
        """The process has ended: a second process tries its transaction once more."""
        message = self._end()
        log.warning("the process that writes the store has ended (%s): another begins", message)
        if self._done is None:
            return
        failure: Exception = WriteFailed(f"the process that writes it has ended ({message})")
        if not self._repeated:
            # The transaction may be committed already: repeating it does no harm.
            self._repeated = True
            try:
                self._submit()
                return
            except OSError as error:
                failure = error
        self._report(failure)

    def _report(self, error: Exception | None) -> None:
        done, self._done = self._done, None
        if done is not None:
            done(error)
