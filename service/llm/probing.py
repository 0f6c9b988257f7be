"""Probes of an LLM server's abilities: a server may ignore an unknown field silently, or refuse it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.llm.answers import NoDecision, NotUnderstood
from service.llm.calibration import check_labels
from service.llm.request_bodies import Constraint, chat_body, label_body

if TYPE_CHECKING:
    from service.llm.client import LLMClient

_TOGETHER_TIMEOUT_S = 15.0
# More UAVs than any fleet has.
_ANY_NUMBER = 1000
# No model names this sensor by itself, so a server that answers it obeys the constraint.
_PROBE_TEXT = "Say hello."
_PROBE_SENSOR, _PROBE_VELOCITIES = 7301, 1
_PROBES: tuple[Constraint, ...] = ("grammar", "structured_outputs", "json_schema")


@dataclass(frozen=True, slots=True)
class Abilities:
    """A server's abilities.

    Attributes:
        constraint: the kind of constraint that it obeys.
        logprobs: whether it gives the probabilities of tokens.
        max_uavs_per_call: number of UAVs that one call may decide for.
    """

    constraint: Constraint
    logprobs: bool
    max_uavs_per_call: int


async def probe(client: LLMClient, model: str | None) -> Abilities:
    """Find out a server's abilities by a few short requests.

    Raises:
        NoDecision: the server does not answer them.
    """
    constraint = await _constraint(client, model)
    logprobs = await _gives_probabilities(client, model, constraint)
    together = await _answers_lists(client, model, constraint, logprobs)
    return Abilities(constraint, logprobs, _ANY_NUMBER if together else 1)


async def _constraint(client: LLMClient, model: str | None) -> Constraint:
    """The first kind of constraint that the server really obeys."""
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


async def _gives_probabilities(client: LLMClient, model: str | None, constraint: Constraint) -> bool:
    body = label_body(model, "Answer in words.", _PROBE_TEXT, constraint, [["A", "B"]])
    try:
        return bool((await client.complete(body)).positions)
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
    """A request that a server answers with the probe's sensor only if it obeys the constraint."""
    return chat_body(model, "Answer in words.", _PROBE_TEXT, constraint, [_PROBE_SENSOR], _PROBE_VELOCITIES)
