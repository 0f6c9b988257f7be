"""Whether a server's answers can be used: counted, probed, and doubted after a probe that passed."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from service.llm.answers import NoDecision
from service.llm.usability import SilenceCounter, Usability
from tests.support.waiting import soon

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


def paused(monkeypatch: pytest.MonkeyPatch) -> tuple[list[float], asyncio.Event]:
    """The pauses before probes; they take no time, except the third, which ends with the event."""
    pauses, third = list[float](), asyncio.Event()

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            await third.wait()
        elif len(pauses) > 3:
            await _unanswered()

    monkeypatch.setattr("service.llm.usability.asyncio", SimpleNamespace(**{**vars(asyncio), "sleep": pause}))
    return pauses, third


async def _unusable_again() -> None:
    raise FAULT


async def test_after_a_usable_answer_the_pauses_before_probes_are_short_again(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses, third = paused(monkeypatch)
    usability = Usability(_unusable_again)
    for _ in range(5):
        usability.unusable(FAULT)
    await soon(lambda: len(pauses) == 3)
    assert pauses == [30.0, 60.0, 120.0]
    usability.usable()
    for _ in range(5):
        usability.unusable(FAULT)
    third.set()
    await soon(lambda: len(pauses) == 4)
    assert pauses[3] == 60.0
    await usability.close()


async def test_a_late_probe_of_a_server_that_recovered_leaves_no_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses, third = paused(monkeypatch)

    async def probe() -> None:
        if not third.is_set():
            raise FAULT

    usability = Usability(probe)
    for _ in range(5):
        usability.unusable(FAULT)
    await soon(lambda: len(pauses) == 3)
    usability.usable()
    third.set()
    for _ in range(10):
        await asyncio.sleep(0)
    for _ in range(4):
        usability.unusable(FAULT)
    assert usability.degraded is None
    usability.unusable(FAULT)
    await soon(lambda: len(pauses) == 4)
    assert pauses[3] == 30.0
    await usability.close()


def test_the_silence_before_an_answer_counts_no_more_after_it() -> None:
    silence = SilenceCounter(10.0)
    assert not silence.cancelled(0.0, 6.0)
    silence.answered_at = 7.0
    assert not silence.cancelled(8.0, 13.0)
    assert silence.cancelled(13.0, 18.0)


def test_the_time_in_which_several_calls_wait_counts_once() -> None:
    silence = SilenceCounter(10.0)
    assert [silence.cancelled(0.0, now) for now in (6.0, 6.5, 9.9)] == [False] * 3
    assert silence.cancelled(1.0, 10.0)
    assert not silence.cancelled(1.0, 19.0), "after a failure it begins anew"


def test_a_call_during_which_another_was_answered_is_not_silent() -> None:
    silence = SilenceCounter(10.0)
    silence.answered_at = 50.0
    assert not silence.cancelled(0.0, 100.0)
