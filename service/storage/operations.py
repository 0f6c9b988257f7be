"""The changes to a store, and the interface of its writer: a process for SQLite, a thread for PostgreSQL.

Each change has the epoch of the lease under which it was made; 0 in a store that is exclusive to one edge.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from service.mission.events import Event
from service.mission.resolved_spec import ResolvedSpec
from shared.wire.schemas import MissionSpec


@dataclass(frozen=True, slots=True)
class Made:
    """A mission begins."""

    mission_id: str
    asked_for: MissionSpec
    spec: ResolvedSpec
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class Entry:
    """Event number ``seq`` of a mission; the first is 1."""

    mission_id: str
    seq: int
    event: Event
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A mission's whole state after event ``seq``, packed; events after ``newest`` are of an earlier mission."""

    mission_id: str
    seq: int
    state: bytes
    epoch: int = 0
    newest: int = 2**62


@dataclass(frozen=True, slots=True)
class Deleted:
    """A mission is deleted."""

    mission_id: str
    epoch: int = 0


Change = Made | Entry | Checkpoint | Deleted


# Called on the event loop: with None when the transaction is durable, or with the reason why it probably is not.
Done = Callable[[Exception | None], None]


class WriteFailed(Exception):
    """The transaction is not durable, as far as the writer knows.

    Attributes:
        lasting: later ones will fail too, until someone acts.
        final: they will until the edge is restarted.
    """

    def __init__(self, reason: str, lasting: bool = False, final: bool = False) -> None:
        super().__init__(reason)
        self.lasting, self.final = lasting, final


class Writer(Protocol):
    """Writes one transaction at a time; called from the event loop."""

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """Begin a transaction of all the changes, in their order; the transaction before must have ended.

        Args:
            done: called once with the result, in a later iteration of the event loop.

        Raises:
            Exception: the transaction could not begin; ``done`` is not called.
        """

    def close(self) -> None:
        """End the writer; no transaction may be under way."""
