"""The processes of one edge, and which of them decides a mission."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from shared.kit.rendezvous import weight

_REMEMBERED = 10_000


@lru_cache(_REMEMBERED)
def slot_of(mission_id: str, slots: int) -> int:
    """Which of ``slots`` processes, 0 to slots - 1, decides a mission: the same in every process and on every machine.

    By rendezvous hashing: with one slot more, only the missions that the new slot gets move.
    """
    return max(range(slots), key=lambda slot: weight(mission_id, str(slot)))


@dataclass(frozen=True, slots=True)
class Member:
    """One of the processes that decide for one edge; all listen on the edge's port, and have the edge's store.

    Attributes:
        slot: its number, from 0.
        slots: number of the processes.
        folder: of the sockets by which the processes reach each other. Only the edge's user can open it.
        store_lock: descriptor of the lock of the SQLite file, which the parent process took for all; None without one.
        replaces: whether it takes the place of a process that has ended, while the others go on.
    """

    slot: int
    slots: int
    folder: Path
    store_lock: int | None = None
    replaces: bool = False

    def slot_of(self, mission_id: str) -> int:
        """Which process decides the mission."""
        return slot_of(mission_id, self.slots)

    def decides(self, mission_id: str) -> bool:
        """Whether this process decides the mission."""
        return slot_of(mission_id, self.slots) == self.slot

    @property
    def others(self) -> list[int]:
        """The slots of the other processes."""
        return [slot for slot in range(self.slots) if slot != self.slot]

    def requests_of(self, slot: int) -> str:
        """Path of the Unix socket at which a process answers the others' HTTP requests, for itself alone."""
        return str(self.folder / f"{slot}.http")

    @property
    def llm(self) -> Path:
        """The file that says where the embedded LLM is, which one more process has for all."""
        return llm_file(self.folder)

    @property
    def bare_requests(self) -> Path:
        """The file in which the processes count their requests to the embedded LLM without its adapter."""
        return self.folder / "bare"

    def connections_of(self, slot: int) -> str:
        """Path of the Unix socket at which a process takes connections over."""
        return str(self.folder / f"{slot}.moved")


def llm_file(folder: Path) -> Path:
    """The file of :attr:`Member.llm`."""
    return folder / "llm.json"
