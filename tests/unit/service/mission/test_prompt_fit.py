"""The size of a mission's prompts: what the LLM's context must hold at least."""

from __future__ import annotations

import pytest

from service.mission.prompt_fit import PromptFit
from service.prompting.prompt import note_block
from shared.wire.schemas import MissionSpec, PromptStyle
from tests.support.missions import PAPER, mission


def least_context(note: str | None) -> int:
    """The tokens of the smallest context that the prompts of a mission with this note fit into."""
    spec = mission(MissionSpec(mode="llm", note=note, prompt=PromptStyle(format="csv"))).spec
    return next(tokens for tokens in range(100_000) if PromptFit(spec, PAPER, tokens, adapted=False).fits())


@pytest.mark.parametrize(("letter", "most_tokens"), [("a", 1), ("ä", 2), ("水", 3)])
def test_a_note_needs_room_for_a_token_of_each_of_its_bytes(letter: str, most_tokens: int) -> None:
    framed = len(note_block("a")) - 1
    assert least_context(50 * letter) - least_context(None) == framed + 50 * most_tokens
