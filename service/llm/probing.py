"""Probes of an LLM server's abilities: a server may ignore an unknown field silently, or refuse it by any status.

LiteLLM's proxy before llama.cpp answers ``post_sampling_probs`` by 500 (BerriAI/litellm 21932), Xinference ``logprobs``
(xorbitsai/inference 1911), vLLM and SGLang constraints that they cannot compile (vllm 13260, sglang 11401). So a probe
that fails means that the ability is absent, and only a plain completion says whether the LLM can be used.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from service.config.settings import Settings
from service.llm.answers import Busy, Completion, NoDecision, NotUnderstood, Unreachable, check_answer
from service.llm.calibration import check_labels, probabilities
from service.llm.request_bodies import (
    WARM_UP_CHOICES,
    Constraint,
    TokenProbabilities,
    WarmUp,
    chat_body,
    label_body,
    warm_up_body,
)

if TYPE_CHECKING:
    from service.llm.client import LLMClient

log = logging.getLogger(__name__)

TOGETHER_TIMEOUT_S = 15.0
# A server that asks for more is not ready.
LONGEST_PAUSE_S = 10.0
# More than the UAVs of any fleet.
_ANY_NUMBER = 1000
# No model names this sensor by itself, so a server that answers it obeys the constraint.
_PROBE_TEXT = "Say hello."
_PROBE_SENSOR, _PROBE_VELOCITIES = 7301, 1
_PROBES: tuple[Constraint, ...] = ("grammar", "structured_outputs", "json_schema")
_PROBABILITIES: tuple[TokenProbabilities, ...] = ("sampled", "top_20", "top_5")
# Names of models without chat, which LM Studio and Ollama list among the others (odysseus 4487).
_NO_CHAT = re.compile(r"embed|rerank|whisper|moderation|\b(tts|bert|clip|dall-e|bge)\b", re.IGNORECASE)
# A server that answers 503 may only be busy: once it answers a plain request, it is probed once more.
_PASSES = 2


@dataclass(slots=True)
class Abilities:
    """A server's model and abilities; ``str()`` has these in words.

    Attributes:
        model: as given, or the first that the server lists; None without a list.
        constraint: the kind of constraint that it obeys.
        logprobs: the probabilities of tokens that it gives.
        max_uavs_per_call: number of UAVs that one call may decide for.
    """

    model: str | None = None
    constraint: Constraint = "none"
    logprobs: TokenProbabilities = "none"
    max_uavs_per_call: int = 1

    def __str__(self) -> str:
        form = "as text that the edge checks" if self.constraint == "none" else f"constrained by {self.constraint}"
        named = {"none": "no token probabilities", "sampled": "token probabilities after sampling"}
        likeliest = named.get(self.logprobs, f"the {self.logprobs[4:]} likeliest tokens")
        together = "several UAVs a call" if self.max_uavs_per_call > 1 else "one UAV a call"
        return f"answers {form}, {likeliest}, {together}"


async def probe(client: LLMClient, model: str | None) -> Abilities:
    """Determine a server's model, unless it is given, and its abilities by a few short requests.

    Raises:
        NoDecision: the server does not answer a plain one, or is gone.
    """
    model = model or await _listed_model(client)
    constraint = await _constraint(client, model)
    logprobs = await _probabilities(client, model, constraint)
    together = await _answers_lists(client, model, constraint, logprobs)
    # A server that had to load its model first lists it now.
    model = model or await _listed_model(client)
    return Abilities(model, constraint, logprobs, _ANY_NUMBER if together else 1)


async def _constraint(client: LLMClient, model: str | None) -> Constraint:
    """The first kind of constraint that the server really obeys."""
    for _ in range(_PASSES):
        answered = perhaps_busy = False
        for constraint in _PROBES:
            try:
                text = (await _asked(client, probe_body(model, constraint))).text
            except (Busy, Unreachable):
                raise
            except NoDecision as failed:
                perhaps_busy = perhaps_busy or not isinstance(failed, NotUnderstood)
                continue
            answered = True
            with suppress(NoDecision):
                check_answer(text, [_PROBE_SENSOR], _PROBE_VELOCITIES)
                return constraint
        if not answered:
            await _asked(client, probe_body(model, "none"))
        if not perhaps_busy:
            break
    return "none"


async def _probabilities(client: LLMClient, model: str | None, constraint: Constraint) -> TokenProbabilities:
    """The best token probabilities that the server gives."""
    for kind in _PROBABILITIES:
        if kind == "sampled" and constraint != "grammar":
            continue
        found = await _answer(
            client, label_body(model, "Answer in words.", _PROBE_TEXT, constraint, [["A", "B"]], kind)
        )
        # llama-cpp-python's server obeys a grammar, but has no probabilities from after sampling.
        if found is not None and found.positions and (found.positions[0].after_sampling or kind != "sampled"):
            return kind
    return "none"


async def _answers_lists(
    client: LLMClient, model: str | None, constraint: Constraint, logprobs: TokenProbabilities
) -> bool:
    """Whether the server names a label of each of two lists, as only a constrained server does."""
    lists = [["A", "B"], ["C", "D"]]
    body = label_body(model, "Answer in words.", _PROBE_TEXT, constraint, lists, logprobs)
    found = None
    with suppress(TimeoutError):
        async with asyncio.timeout(TOGETHER_TIMEOUT_S):
            found = await _answer(client, body)
    with suppress(NoDecision):
        return found is not None and bool(check_labels(found.text, lists))
    return False


async def _asked(client: LLMClient, body: dict[str, Any]) -> Completion:
    """The answer to a probe, after the short pauses that the server asks for; raises :class:`NoDecision`."""
    while True:
        try:
            return await client.complete(body)
        except Busy as busy:
            if busy.pause_s > LONGEST_PAUSE_S:
                raise
            await asyncio.sleep(busy.pause_s)


async def _answer(client: LLMClient, body: dict[str, Any]) -> Completion | None:
    """The answer to a probe, None if it fails; raises :class:`Busy` and :class:`Unreachable`."""
    try:
        return await _asked(client, body)
    except (Busy, Unreachable):
        raise
    except NoDecision:
        return None


async def _listed_model(client: LLMClient) -> str | None:
    """The first listed model that may chat, else the first; None without a list. Raises :class:`Unreachable`."""
    try:
        names = await client.models()
        names = [name for name in names if not _NO_CHAT.search(name)] or names
        if len(names) > 1:
            log.warning("of the listed models the first is used: %s; AICVDS_LLM_MODEL names another", names[:9])
        return names[0] if names else None
    except Unreachable:
        raise
    except NoDecision as error:
        log.info("the server lists no models, so requests name none: %s", error)
        return None


async def first_decision(
    client: LLMClient, model: str | None, warm_up: WarmUp, able: Abilities, enough_s: float = 0.0
) -> tuple[Completion, float]:
    """The answer to the warm-up, checked as a decision's, and its seconds; raises :class:`NoDecision`.

    An answer that takes longer than ``enough_s`` is asked for again: then the server's prefix cache has the static
    block, as it has in decisions.
    """
    for _ in range(2):
        started = time.monotonic()
        answer = await client.complete(warm_up_body(model, warm_up, able.constraint, able.logprobs))
        seconds = time.monotonic() - started
        if warm_up.labels is None:
            check_answer(answer.text, *WARM_UP_CHOICES)
        else:
            probabilities(answer, [warm_up.labels])
        if seconds <= enough_s:
            break
    return answer, seconds


def probe_body(model: str | None, constraint: Constraint) -> dict[str, Any]:
    """A request that a server answers with the probe's sensor only if it obeys the constraint."""
    return chat_body(model, "Answer in words.", _PROBE_TEXT, constraint, [_PROBE_SENSOR], _PROBE_VELOCITIES)


@dataclass(frozen=True, slots=True)
class Examination:
    """The abilities of a server, and one decision of it.

    Attributes:
        terms: changes of a request that it demands, in words.
        seconds: of the decision ``answer``, with the static block in the prefix cache if the server has one.
    """

    abilities: Abilities
    terms: str
    answer: Completion
    seconds: float


async def examine(settings: Settings, warm_up: WarmUp) -> Examination:
    """Examine the one server that the settings name.

    Raises:
        NoDecision: the server is gone, or its answer to the decision cannot be used; the text has its own words.
    """
    # An edge without an LLM server loads no client.
    from service.llm.client import client_of

    client = client_of(settings)
    try:
        able = await probe(client, settings.llm_model)
        return Examination(able, str(client.terms), *await first_decision(client, able.model, warm_up, able))
    finally:
        await client.close()
