"""The parent of the processes of ``aicvds serve --processes N``: it starts them, and others where they end.

It imports neither torch nor FastAPI, and forks: each child loads the edge by itself.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from service.config.process_member import Member
from service.config.settings import Settings
from service.storage.locks import FileLock, StoreUnusable, sqlite_file

# The pause before a process is started again, doubled with each failure up to the most, and how long a process must
# have lasted for the next failure to be the first.
_FIRST_PAUSE_S, _MOST_PAUSE_S, _LASTED_S = 0.1, 10.0, 60.0
# So many failures one after another end the edge.
_MOST_FAILURES = 8
# The exit code of a command that cannot begin: its settings are wrong, and will be the next time.
_UNUSABLE = 2
_SIGNALS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGCHLD}
_PR_SET_PDEATHSIG = 1
# Characters of the folder's path at most: a Unix socket's path has at most 107.
_MOST_PATH = 90


@dataclass(slots=True)
class _Child:
    """A process and its place: its slot among the deciding ones, or None for the one with the LLM."""

    slot: int | None
    pid: int = 0
    starts: int = 0
    failures: int = 0
    started_at: float = 0.0
    start_at: float | None = 0.0


class Parent:
    """Starts the processes of one edge, and ends when they have ended.

    Args:
        listener: the edge's port; the children inherit it, so that a connection waits for whichever is there.
        host_llm: serves the embedded LLM from the folder's file and returns an exit code; None where there is none.

    Raises:
        StoreUnusable: another edge uses the SQLite file, or its lock cannot be made.
        OSError: there is no folder for the processes' sockets.
    """

    def __init__(
        self, settings: Settings, listener: socket.socket, host_llm: Callable[[Path], int] | None = None
    ) -> None:
        self._settings = settings
        self._listener = listener
        self._host_llm = host_llm
        self._lock = _locked(settings.store)
        self._folder = _folder()
        slots: list[int | None] = [*range(settings.processes)]
        self._children = [_Child(slot) for slot in ([None, *slots] if host_llm else slots)]
        self._ending = False
        self._code = 0

    def run(self) -> Member | int:
        """Supervise the children until they have ended; returns the exit code, and in each deciding child its place."""
        signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        while self._deciding or not self._ending:
            for child in self._children:
                if child.start_at is not None and child.start_at <= time.monotonic():
                    place = self._start(child)
                    if place is not None:
                        return place
            due = [child.start_at for child in self._children if child.start_at is not None]
            found = signal.sigtimedwait(_SIGNALS, max(0.0, min(due) - time.monotonic()) if due else 3600.0)
            if found is not None and found.si_signo != signal.SIGCHLD:
                self._end(0 if found.si_signo == signal.SIGTERM else 128 + found.si_signo)
            self._reap()
        self._close()
        return self._code

    @property
    def _deciding(self) -> list[_Child]:
        return [child for child in self._children if child.slot is not None and child.pid]

    def _start(self, child: _Child) -> Member | int | None:
        """Fork; returns None in the parent, and in the child what :meth:`run` returns there."""
        parent = os.getpid()
        child.starts, child.started_at, child.start_at = child.starts + 1, time.monotonic(), None
        sys.stderr.flush()
        child.pid = os.fork()
        if child.pid:
            return None
        # Signals of a terminal are for the parent.
        os.setsid()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        # A parent that is killed takes its children along.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            return 1
        if child.slot is None:
            assert self._host_llm is not None
            return self._host_llm(self._folder)
        lock = None if self._lock is None else self._lock.descriptors[0]
        return Member(child.slot, self._settings.processes, self._folder, lock, child.starts > 1)

    def _reap(self) -> None:
        """Find which children have ended, and plan when to start others."""
        with suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                pid, status = ended
                for child in self._children:
                    if child.pid == pid:
                        child.pid = 0
                        self._ended(child, os.waitstatus_to_exitcode(status))

    def _ended(self, child: _Child, code: int) -> None:
        if self._ending:
            return
        if code == _UNUSABLE and child.starts == 1:
            # It has said why.
            if child.slot is not None:
                self._end(code)
            return
        lasted = time.monotonic() - child.started_at > _LASTED_S
        child.failures = 1 if lasted else child.failures + 1
        why = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        name = "the process of the LLM" if child.slot is None else f"process {child.slot}"
        if child.failures >= _MOST_FAILURES and child.slot is not None:
            self._say("error", f"{name} has ended {why}, {child.failures} times in a row: the edge ends")
            self._end(1)
            return
        pause_s = min(_MOST_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** (child.failures - 1))
        self._say("warning", f"{name} has ended {why}: another begins")
        child.start_at = time.monotonic() + pause_s

    def _end(self, code: int) -> None:
        """Ask the deciding processes to end, and start no others."""
        if not self._ending:
            self._ending, self._code = True, code
            self._listener.close()
        for child in self._children:
            child.start_at = None
        for child in self._deciding:
            os.kill(child.pid, signal.SIGTERM)

    def _close(self) -> None:
        """The deciding processes have ended: end the LLM's, which has nothing to keep, and remove the sockets."""
        for child in self._children:
            if child.pid:
                os.kill(child.pid, signal.SIGKILL)
                os.waitpid(child.pid, 0)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _say(self, level: str, text: str) -> None:
        """A line of the log, in the log's form; the logger's thread would not survive a fork."""
        if self._settings.log_format == "json":
            at = datetime.now(UTC).isoformat().replace("+00:00", "Z")
            text = json.dumps({"event": text, "level": level, "logger": __name__, "timestamp": at})
        else:
            text = f"aicvds serve: {text}"
        print(text, file=sys.stderr, flush=True)


def _locked(store: str) -> FileLock | None:
    """The lock of the store's SQLite file, if it is one; raises ``StoreUnusable``."""
    file = sqlite_file(store)
    if file is None:
        return None
    try:
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        return FileLock(file)
    except OSError as error:
        raise StoreUnusable(str(error)) from None


def _folder() -> Path:
    """A new folder that only this user can open; raises ``OSError``."""
    folder = tempfile.mkdtemp(prefix="aicvds-")
    if len(folder) > _MOST_PATH:
        os.rmdir(folder)
        raise OSError(f"{folder} is too long a path for sockets: set TMPDIR to a shorter one")
    return Path(folder)
