"""Probes of a server's abilities, with a client that answers as it is told."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, cast

import pytest

from service.llm.answers import Busy, Completion, NoDecision, NotUnderstood, TokenPosition, Unreachable
from service.llm.client import LLMClient
from service.llm.probing import Abilities, first_decision, probe
from service.llm.request_bodies import WarmUp

LABELS = WarmUp("instructions", "state", ["A", "B"])
Answer = Callable[[dict[str, Any]], str | NoDecision]


class Told:
    """A client of a server that answers each body so, and lists these models, one list after the other."""

    def __init__(self, answer: Answer, *models: list[str] | NoDecision) -> None:
        self.answer, self.listed = answer, list(models)
        self.bodies: list[dict[str, Any]] = []

    async def complete(self, body: dict[str, Any], session: str | None = None) -> Completion:
        self.bodies.append(body)
        found = self.answer(body)
        if isinstance(found, NoDecision):
            raise found
        position = TokenPosition(found, {found: 0.9, "B": 0.1}) if "logprobs" in body else None
        return Completion(found, None, None, None, (position,) if position else ())

    async def models(self) -> list[str]:
        found = self.listed.pop(0) if len(self.listed) > 1 else self.listed[0]
        if isinstance(found, NoDecision):
            raise found
        return found

    @property
    def client(self) -> LLMClient:
        return cast(LLMClient, self)


@pytest.mark.parametrize(("enough_s", "times"), [(1e9, 1), (0.0, 2)])
async def test_a_first_decision_that_takes_long_is_timed_again(enough_s: float, times: int) -> None:
    reported = Told(lambda _: "A", [])
    answer, seconds = await first_decision(reported.client, "model", LABELS, Abilities(), enough_s)
    assert (answer.text, len(reported.bodies)) == ("A", times)
    assert seconds >= 0.0


@pytest.mark.parametrize("text", ["C", "hello", ""])
async def test_a_first_decision_that_names_no_label_cannot_be_used(text: str) -> None:
    with pytest.raises(NoDecision) as caught:
        await first_decision(Told(lambda _: text, []).client, "model", LABELS, Abilities())
    assert caught.value.reason == "answer_format"


@pytest.mark.parametrize(
    ("lists", "model"),
    [
        ([["first", "second"]], "first"),
        ([["nomic-embed-text", "bge-m3", "second"]], "second"),
        ([["nomic-embed-text"]], "nomic-embed-text"),
        ([NoDecision("llm_status", "HTTP 404"), ["loaded"]], "loaded"),
        ([[], ["loaded"]], "loaded"),
        ([[]], None),
    ],
)
async def test_the_model_is_the_first_listed_one_that_may_chat_also_once_it_is_loaded(
    lists: list[list[str] | NoDecision], model: str | None
) -> None:
    assert (await probe(Told(lambda _: "hello", *lists).client, None)).model == model


async def test_a_given_model_is_not_looked_for() -> None:
    reported = Told(lambda _: "hello", ["first"])
    assert (await probe(reported.client, "given")).model == "given"
    assert {body["model"] for body in reported.bodies} == {"given"}


async def test_a_server_that_asks_for_a_long_pause_is_not_ready() -> None:
    busy = Busy("HTTP 503", time.monotonic() + 12.0)
    reported = Told(lambda _: "hello" if len(reported.bodies) > 1 else busy, ["first"])
    with pytest.raises(Busy):
        await probe(reported.client, None)
    assert len(reported.bodies) == 1


async def test_a_server_that_is_gone_is_no_server_without_abilities() -> None:
    reported = Told(lambda _: Unreachable("llm_error", "refused"), ["first"])
    with pytest.raises(Unreachable):
        await probe(reported.client, "model")
    assert len(reported.bodies) == 1


async def test_a_server_that_refuses_plain_requests_too_is_no_server() -> None:
    with pytest.raises(NotUnderstood):
        await probe(Told(lambda _: NotUnderstood("llm_status", "HTTP 404"), ["first"]).client, None)
