"""The embedded LLM of an edge with several processes: one process more has it, and they use it over loopback."""

from __future__ import annotations

import asyncio
import json
import mmap
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from service.config.process_member import Member, llm_file
from service.config.settings import Settings
from service.llm.adapter_version import AdapterUnusable
from service.llm.embedded import EmbeddedServer, LoadFailed, embed
from service.llm.model_file import ModelMissing

_UNUSABLE = 2
# What one process says to the others.
_SAID = ("base_url", "api_key", "model", "bare_model", "notes_model", "without_adapter", "with_orders")
_CELL = 8
# Seconds between two looks whether it is loaded.
_LOADING_S = 0.1


def host(settings: Settings, folder: Path) -> int:
    """Load the embedded LLM, write into the folder where it is, and have it until a signal ends this process.

    Returns:
        an exit code, where it cannot be loaded; the folder then has the reason.
    """
    file = llm_file(folder)
    # Of a process that was killed.
    file.unlink(missing_ok=True)
    try:
        server = embed(settings)
    except (ModelMissing, AdapterUnusable, LoadFailed) as error:
        _write(file, {"error": str(error)})
        return _UNUSABLE
    _write(file, {name: getattr(server, name) for name in _SAID})
    signal.pause()
    return 0


class HostedServer(EmbeddedServer):
    """The embedded LLM that another process has.

    Args:
        file: what :func:`host` wrote.

    Raises:
        LoadFailed: that process could not load it.
    """

    def __init__(self, member: Member, file: bytes) -> None:
        self._member = member
        self._file = file
        said = json.loads(file)
        if "error" in said:
            raise LoadFailed(said["error"])
        for name in _SAID:
            setattr(self, name, said[name])
        # Each process counts its own requests without the adapter, before and after, so that no count is lost.
        self._counts = _counts(member)
        self._all_read_after = bytes(_CELL * member.slots)

    @property
    def gone(self) -> bool:
        """Whether another process has taken that one's place; one that has only ended looks as if it were there."""
        try:
            return self._member.llm.read_bytes() != self._file
        except OSError:
            return True

    @contextmanager
    def request(self, system: str, trained: str) -> Iterator[dict[str, Any]]:
        """As :meth:`EmbeddedServer.request`, after the requests of all processes."""
        if not self.without_adapter:
            yield {}
            return
        if system != trained:
            self._count()
            try:
                yield self.without_adapter
            finally:
                self._count()
            return
        bare = bytes(self._counts)
        yield {} if bare == self._all_read_after else {"cache_prompt": False}
        self._all_read_after = bare

    def close(self) -> None:
        """Leave the LLM to the other processes."""
        self._counts.close()

    def _count(self) -> None:
        mine = slice(_CELL * self._member.slot, _CELL * (self._member.slot + 1))
        self._counts[mine] = (int.from_bytes(self._counts[mine]) + 1).to_bytes(_CELL)


async def hosted(member: Member, _: Settings) -> EmbeddedServer:
    """The LLM, once the process that has it has loaded it; raises as :class:`HostedServer`."""
    while True:
        with suppress(FileNotFoundError):
            return HostedServer(member, member.llm.read_bytes())
        await asyncio.sleep(_LOADING_S)


def _counts(member: Member) -> mmap.mmap:
    """Memory of all processes, with a number for each."""
    size = _CELL * member.slots
    with os.fdopen(os.open(member.bare_requests, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
        file.truncate(size)
        return mmap.mmap(file.fileno(), size)


def _write(file: Path, said: dict[str, Any]) -> None:
    part = file.with_suffix(".part")
    part.write_text(json.dumps(said))
    with suppress(FileNotFoundError):
        part.replace(file)
