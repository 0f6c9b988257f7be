"""Reading an LLM's choice among labels: probabilities of the first token, less what it favours whatever is asked.

Language models favour labels for their name and for their place in the prompt (Zheng et al. 2024, "Large Language
Models Are Not Robust Multiple Choice Selectors"). Contextual calibration (Zhao et al. 2021, "Calibrate Before Use")
asks the same prompt with content that says nothing, takes the mean of the answers for the bias b, and divides:
``p'(a) = p(a) / b(a)``, renormalised over the labels offered. A label's place in the prompt is fixed by its name, so
one bias covers both. It is measured once for a model and a static block, in the background after the first decision.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence

from service.llm.answer import NoDecision, check_label
from service.llm.client import Completion
from service.llm.upstream import Upstream

log = logging.getLogger(__name__)

# Left to the labels that were not named by a server that only names one.
_SMOOTHING = 0.05
# Of the uniform probability: a label that the content-free prompts hardly ever drew is not multiplied without bound.
_LEAST_BIAS = 0.1
_KEPT = 64
_ATTEMPTS = 3
_TIMEOUT_S = 30.0


def probabilities(completion: Completion, labels: Collection[str]) -> dict[str, float]:
    """The LLM's probability of each label offered, summing to 1.

    A label that is not among the tokens told gets half of the least that is. Where the server tells no probabilities,
    its answer gets 0.95 and all labels share the rest.

    Raises:
        NoDecision: neither the tokens told nor the text name a label offered.
    """
    told = {label: completion.first_token[label] for label in labels if label in completion.first_token}
    if sum(told.values()) <= 0.0:
        answer = check_label(completion.text, labels)
        share = _SMOOTHING / len(labels)
        return {label: share + (1.0 - _SMOOTHING) * (label == answer) for label in labels}
    least = 0.5 * min(value for value in told.values() if value > 0.0)
    return _normalised({label: told.get(label) or least for label in labels})


def calibrated(told: Mapping[str, float], bias: Mapping[str, float]) -> dict[str, float]:
    """``p(a) / b(a)``, renormalised; the bias is that of the labels offered among themselves."""
    offered = _normalised({label: bias[label] for label in told})
    least = _LEAST_BIAS / len(told)
    return _normalised({label: value / max(offered[label], least) for label, value in told.items()})


class LabelReader:
    """Asks one LLM for labels, and learns what it favours, for every mission of a service."""

    def __init__(self, upstream: Upstream) -> None:
        self._upstream = upstream
        self._bias: OrderedDict[tuple[str | None, str], dict[str, float]] = OrderedDict()
        self._attempts: dict[tuple[str | None, str], int] = {}
        self._task: asyncio.Task[None] | None = None

    def bias(self, static: str) -> dict[str, float] | None:
        """What the present model favours under a static block, once that is measured."""
        return self._bias.get((self._upstream.model, static))

    async def ask(self, static: str, user: str, labels: Sequence[str]) -> Completion:
        """One answer; raises :class:`NoDecision`. What it tells is for :meth:`read`."""
        return await self._upstream.ask_label(static, user, labels)

    def read(self, completion: Completion, static: str, labels: Collection[str]) -> dict[str, float]:
        """The probabilities of the labels, without the bias where that is known; raises :class:`NoDecision`."""
        told = probabilities(completion, labels)
        bias = self.bias(static)
        return calibrated(told, bias) if bias and completion.first_token else told

    def calibrate(self, static: str, texts: Sequence[str], labels: Sequence[str]) -> None:
        """Measure the bias in the background, unless it is known, being measured, or cannot be."""
        key = (self._upstream.model, static)
        busy = self._task is not None and not self._task.done()
        if busy or key in self._bias or not self._upstream.logprobs or self._attempts.get(key, 0) >= _ATTEMPTS:
            return
        self._attempts[key] = self._attempts.get(key, 0) + 1
        self._task = asyncio.create_task(self._measure(key, texts, labels), name="calibration")

    async def close(self) -> None:
        """Give up measuring."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _measure(self, key: tuple[str | None, str], texts: Sequence[str], labels: Sequence[str]) -> None:
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                told = [probabilities(await self.ask(key[1], text, labels), labels) for text in texts]
        except (NoDecision, TimeoutError) as error:
            log.warning("label bias not measured: %s", error)
            return
        self._bias[key] = {label: sum(p[label] for p in told) / len(told) for label in labels}
        while len(self._bias) > _KEPT:
            self._bias.popitem(last=False)
        if len(self._attempts) > 16 * _KEPT:
            self._attempts.clear()


def _normalised(values: Mapping[str, float]) -> dict[str, float]:
    total = sum(values.values())
    return {label: value / total for label, value in values.items()}
