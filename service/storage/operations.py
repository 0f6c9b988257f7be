"""The changes to a store.

Each has the epoch of the lease under which it was made; 0 in a store that is exclusive to one edge.
"""

from dataclasses import dataclass

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
    """A mission's whole state after event ``seq``, packed."""

    mission_id: str
    seq: int
    state: bytes
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class Deleted:
    """A mission is deleted."""

    mission_id: str
    epoch: int = 0


Change = Made | Entry | Checkpoint | Deleted
