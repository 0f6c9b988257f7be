"""The prompt, in three blocks ordered for prefix caching: static, experiences, current task.

The static block is byte-identical for a mission's life, and the experiences only grow between compactions. So an LLM
server with a prefix cache processes only the last block anew. The column names are part of the static block.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from service.prompting.unpruned_state import UnprunedState


@dataclass(frozen=True, slots=True)
class Prompt:
    """One prompt.

    Attributes:
        state: the last block.
        uncompressed: the last block without pruning by attention and without masks.
        kept: the sensors' rows of ``state`` if it is ``uncompressed`` but for the other rows; None if it differs.
    """

    static: str
    experiences: str
    state: str
    uncompressed: UnprunedState
    kept: Sequence[int] | None = None

    @property
    def user(self) -> str:
        """The user message: experiences, then the current task."""
        return f"{self.experiences}{self.state}"


def note_block(note: str | None) -> str:
    """The static block's text for the operator's note; empty without a note."""
    return f"The operator's note, to be obeyed: {note}\n\n" if note else ""
