"""What an LLM server can do, found out by asking it: it may ignore a field silently, or refuse it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.llm.answer_format import Constraint, NoDecision, check_labels
from service.llm.completion import NotUnderstood
from service.llm.request_bodies import chat_body, label_body

if TYPE_CHECKING:
    from service.llm.client import LLMClient

_TOGETHER_TIMEOUT_S = 15.0
_ANY_NUMBER = 1000
# No model says this of its own accord, so a server that answers it has obeyed the constraint.
_PROBE_TEXT = "Say hello."
_PROBE_SENSOR, _PROBE_VELOCITIES = 7301, 1
_PROBES: tuple[Constraint, ...] = ("grammar", "structured_outputs", "json_schema")


@dataclass(frozen=True, slots=True)
class Abilities:
    """How a server can be held to the answer's form, whether it tells the probabilities of tokens, and about how many
    UAVs it can be asked at once."""

    constraint: Constraint
    logprobs: bool
    most_together: int


async def probe(client: LLMClient, model: str | None) -> Abilities:
    """Ask a few short questions.

    Raises:
        NoDecision: the server does not answer them.
    """
    constraint = await _constraint(client, model)
    logprobs = await _tells_probabilities(client, model, constraint)
    together = await _answers_lists(client, model, constraint, logprobs)
    return Abilities(constraint, logprobs, _ANY_NUMBER if together else 1)


async def _constraint(client: LLMClient, model: str | None) -> Constraint:
    """The first way of constraining that the server really obeys: it may ignore an unknown field silently."""
    refusal: NotUnderstood | None = None
    for constraint in _PROBES:
        try:
            body = probe_body(model, constraint)
            text = (await client.complete(body)).text
        except NotUnderstood as failed:
            refusal = failed
            continue
        if str(_PROBE_SENSOR) in text:
            return constraint
    if refusal is not None:
        await client.complete(probe_body(model, "none"))
    return "none"


async def _tells_probabilities(client: LLMClient, model: str | None, constraint: Constraint) -> bool:
    """Whether the server tells the probabilities of tokens: it may ignore or refuse the field."""
    body = label_body(model, "Answer in words.", _PROBE_TEXT, constraint, [["A", "B"]])
    try:
        return bool((await client.complete(body)).places)
    except NotUnderstood:
        return False


async def _answers_lists(client: LLMClient, model: str | None, constraint: Constraint, logprobs: bool) -> bool:
    """Whether the server names a label of each of two lists, which only one that obeys a constraint does."""
    lists = [["A", "B"], ["C", "D"]]
    body = label_body(model, "Answer in words.", _PROBE_TEXT, constraint, lists, logprobs)
    try:
        async with asyncio.timeout(_TOGETHER_TIMEOUT_S):
            check_labels((await client.complete(body)).text, lists)
    except NoDecision as error:
        if isinstance(error, NotUnderstood) or error.reason == "answer_format":
            return False
        raise
    except TimeoutError:
        return False
    return True


def probe_body(model: str | None, constraint: Constraint) -> dict[str, Any]:
    """A question that only a server which obeys the constraint answers with the sensor that it names."""
    return chat_body(model, "Answer in words.", _PROBE_TEXT, constraint, [_PROBE_SENSOR], _PROBE_VELOCITIES)
