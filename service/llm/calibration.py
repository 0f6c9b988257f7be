"""Reading an LLM's choice among labels: the probabilities of its tokens, less what it favours whatever is asked.

Language models favour labels for their name and for their place in the prompt (Zheng et al. 2024, "Large Language
Models Are Not Robust Multiple Choice Selectors"). Contextual calibration (Zhao et al. 2021, "Calibrate Before Use")
asks the same prompt with content that says nothing, takes the mean of the answers for the bias b, and divides:
``p'(a) = p(a) / b(a)``, renormalised over the labels offered. A label's place in the prompt is fixed by its name, so
one bias covers both. It is measured once for a model, a static block and a number of lists, in the background after the
first decision. Of several lists, the later ones' bias is that after the letters which the model drew for the earlier.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Collection, Mapping, Sequence

from service.llm.answer_format import NoDecision, check_labels
from service.llm.completion import Completion
from service.llm.server_pool import ServerPool
from shared.bounded import BoundedDict

log = logging.getLogger(__name__)

# Left to the labels that were not named by a server that only names one.
_SMOOTHING = 0.05
# Of the uniform probability: a label that the content-free prompts hardly ever drew is not multiplied without bound.
_LEAST_BIAS = 0.1
# Less than any probability that means something, and far from where halving or dividing loses it.
_TINY = 1e-12
_KEPT = 64
_ATTEMPTS = 3
_TIMEOUT_S = 30.0
# The model, the static block, and how many lists of labels.
_Question = tuple[str | None, str, int]


def probabilities(completion: Completion, lists: Sequence[Collection[str]]) -> list[dict[str, float]]:
    """The LLM's probability of each label offered, summing to 1, for each list that it was to name one of.

    A label that is not among the tokens told gets half of the least that is. Where the server tells no probabilities,
    its answer gets 0.95 and all labels of the list share the rest.

    Raises:
        NoDecision: neither the tokens told nor the text name a label offered.
    """
    # Between several labels stand the ends of lines; a single one stands first, whatever was drawn.
    places = completion.places if len(lists) == 1 else [place for place in completion.places if place.token.strip()]
    told = [
        {label: place.likeliest[label] for label in labels if label in place.likeliest}
        for place, labels in zip(places, lists, strict=False)
    ]
    if len(told) == len(lists) and all(sum(place.values()) > 0.0 for place in told):
        return [_filled(place, labels) for place, labels in zip(told, lists, strict=True)]
    answers = check_labels(completion.text, lists)
    return [
        {label: _SMOOTHING / len(labels) + (1.0 - _SMOOTHING) * (label == answer) for label in labels}
        for answer, labels in zip(answers, lists, strict=True)
    ]


def _filled(told: Mapping[str, float], labels: Collection[str]) -> dict[str, float]:
    least = max(_TINY, 0.5 * min(value for value in told.values() if value > 0.0))
    return _normalised({label: told.get(label) or least for label in labels})


def calibrated(told: Mapping[str, float], bias: Mapping[str, float]) -> dict[str, float]:
    """``p(a) / b(a)``, renormalised; the bias is that of the labels offered among themselves."""
    offered = _normalised({label: bias[label] for label in told})
    least = _LEAST_BIAS / len(told)
    return _normalised({label: value / max(offered[label], least) for label, value in told.items()})


class LabelReader:
    """Asks one LLM for labels, and learns what it favours, for every mission of a service.

    One question may have several lists of labels, of each of which the answer is to name one.
    """

    def __init__(self, llm: ServerPool) -> None:
        self._llm = llm
        self._bias = BoundedDict[_Question, list[dict[str, float]]](_KEPT)
        self._attempts: dict[_Question, int] = {}
        self._task: asyncio.Task[None] | None = None

    def bias(self, model: str | None, static: str, lists: int = 1) -> list[dict[str, float]] | None:
        """What a model favours under a static block, by list, once that is measured."""
        return self._bias.get((model, static, lists))

    async def ask(self, static: str, user: str, lists: Sequence[Sequence[str]]) -> Completion:
        """One answer; raises :class:`NoDecision`. What it tells is for :meth:`read`."""
        return await self._llm.ask_labels(static, user, lists)

    def read(self, completion: Completion, static: str, lists: Sequence[Collection[str]]) -> list[dict[str, float]]:
        """The labels' probabilities by list, without the bias where that is known; raises :class:`NoDecision`."""
        told = probabilities(completion, lists)
        bias = self.bias(completion.model, static, len(lists))
        if bias is None or not completion.places:
            return told
        return [calibrated(*pair) for pair in zip(told, bias, strict=True)]

    def calibrate(self, model: str | None, static: str, texts: Sequence[str], lists: Sequence[Sequence[str]]) -> None:
        """Measure a model's bias in the background, unless it is known, being measured, or cannot be.

        Args:
            texts: user messages that say nothing.
            lists: every label that a question under this static block can offer, by list.
        """
        key = (model, static, len(lists))
        busy = self._task is not None and not self._task.done()
        if busy or key in self._bias or not self._llm.logprobs or self._attempts.get(key, 0) >= _ATTEMPTS:
            return
        self._attempts[key] = self._attempts.get(key, 0) + 1
        self._task = asyncio.create_task(self._measure(key, texts, lists), name="calibration")

    async def close(self) -> None:
        """Give up measuring."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _measure(self, key: _Question, texts: Sequence[str], lists: Sequence[Sequence[str]]) -> None:
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                answers = [await self.ask(key[1], text, lists) for text in texts]
            told = [probabilities(answer, lists) for answer in answers]
        except (NoDecision, TimeoutError) as error:
            log.warning("label bias not measured: %s", error)
            return
        if {answer.model for answer in answers} != {key[0]}:
            # Another server answered meanwhile.
            return
        self._bias[key] = [
            {label: sum(answer[at][label] for answer in told) / len(told) for label in labels}
            for at, labels in enumerate(lists)
        ]
        if len(self._attempts) > 16 * _KEPT:
            self._attempts.clear()


def _normalised(values: Mapping[str, float]) -> dict[str, float]:
    total = sum(values.values())
    return {label: value / total for label, value in values.items()}
