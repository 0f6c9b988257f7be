"""Who writes to a store, beside the event loop: a process for SQLite, a thread for PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from service.storage.operations import Change

# Called on the event loop: with None when all is on disk, or with why nothing is, as far as is known.
Done = Callable[[Exception | None], None]


class WriteFailed(Exception):
    """What was to be written is not on disk, as far as is known."""


class Writer(Protocol):
    """Writes one transaction after the other; called from the event loop."""

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """Begin to write all of it, in order, or nothing; the one before must have ended.

        Args:
            done: told once, in a later turn of the loop, how it ended.

        Raises:
            Exception: it could not begin; ``done`` is not told.
        """

    def close(self) -> None:
        """End; nothing may be on its way."""
