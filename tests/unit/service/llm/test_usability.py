"""Whether a server's answers can be used: counted, probed, and doubted after a probe that passed."""

from __future__ import annotations

import asyncio

import pytest

from service.llm.answers import NoDecision
from service.llm.usability import Usability

FAULT = NoDecision("answer_format", "'I would fly\n to 3'")


async def _unanswered() -> None:
    await asyncio.Event().wait()


async def test_five_unusable_answers_in_a_row_degrade_a_server_and_a_usable_one_restores_it() -> None:
    usability = Usability(_unanswered)
    for _ in range(4):
        usability.unusable(FAULT)
    usability.usable()
    for _ in range(4):
        usability.unusable(FAULT)
    assert usability.degraded is None
    usability.unusable(FAULT)
    expected = "5 answers in a row cannot be used, the last (answer_format): 'I would fly? to 3'"
    assert usability.degraded == expected
    usability.usable()
    assert usability.degraded is None
    await usability.close()


async def test_after_a_passed_probe_the_first_unusable_answer_degrades_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.llm.usability.FIRST_UNUSABLE_S", 0.0)
    probes = 0

    async def probe() -> None:
        nonlocal probes
        probes += 1
        if probes == 1:
            raise FAULT

    usability = Usability(probe)
    for _ in range(5):
        usability.unusable(FAULT)
    while usability.degraded is not None:
        await asyncio.sleep(0)
    assert probes == 2
    usability.unusable(FAULT)
    assert usability.degraded is not None and usability.degraded.startswith("1 answer cannot be used")
    await usability.close()
