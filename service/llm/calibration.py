"""An LLM's choice among labels: the probabilities of its tokens, corrected for the model's label bias.

Language models prefer labels for their name and for their position in the prompt (Zheng et al. 2024, "Large Language
Models Are Not Robust Multiple Choice Selectors"). Contextual calibration (Zhao et al. 2021, "Calibrate Before Use")
sends the same prompt with content-free text, takes the mean of the answers as the bias b, and divides:
``p'(a) = p(a) / b(a)``, renormalised over the offered labels. A label's name fixes its position in the prompt, so one
bias covers both. The bias is measured once for a model, a static block and a number of lists, in the background after
the first decision. The bias of a later list is the one after the labels drawn for the earlier lists.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence

from service.llm.answers import Completion, NoDecision
from shared.kit.bounded import BoundedDict

log = logging.getLogger(__name__)

# Probability of all labels but the named one, where the server gives no probabilities.
_SMOOTHING = 0.05
# Least bias, as a share of the uniform probability: the factor of a label that is hardly ever drawn stays bounded.
_LEAST_BIAS = 0.1
# Less than any meaningful probability, and large enough to be halved and divided without underflow.
_TINY = 1e-12
# Least probability of all labels together. A model that answers by a label gives them nearly all of it.
_LEAST_MASS = 1e-3
_MOST_BIASES = 64
_ATTEMPTS = 3
TIMEOUT_S = 30.0
# Asks the LLM: a static block, a user message, and the lists of labels.
Ask = Callable[[str, str, Sequence[Sequence[str]]], Awaitable[Completion]]
# The model, the static block, and the number of lists of labels.
_Question = tuple[str | None, str, int]


def probabilities(completion: Completion, lists: Sequence[Collection[str]]) -> list[dict[str, float]]:
    """The LLM's probabilities of the labels of each list; those of a list sum to 1.

    A label that is not among the likeliest tokens gets half of the least probability among them. Where the server gives
    no probabilities of labels, its answer gets 0.95, and all labels of the list share the rest.

    Raises:
        NoDecision: neither the likeliest tokens nor the text name an offered label, or all labels together are hardly
            probable: a thinking model begins with another token, and renormalised its labels would be noise.
    """
    found = _by_label(completion, lists)
    if found:
        least = min(sum(by_label.values()) for by_label in found)
        if least < _LEAST_MASS:
            detail = f"{completion.text[:80]!r}: the labels have {least:.1g} of the probability"
            raise NoDecision("answer_format", detail)
        return [_filled(by_label, labels) for by_label, labels in zip(found, lists, strict=True)]
    answers = check_labels(completion.text, lists)
    return [
        {label: _SMOOTHING / len(labels) + (1.0 - _SMOOTHING) * (label == answer) for label in labels}
        for answer, labels in zip(answers, lists, strict=True)
    ]


def _by_label(completion: Completion, lists: Sequence[Collection[str]]) -> list[dict[str, float]]:
    """Each list's labels among the likeliest tokens of its position; empty if a position has none of its labels."""
    # Several labels have ends of lines between them. A single label is at the first position, whatever token was drawn.
    positions = completion.positions
    if len(lists) > 1:
        positions = tuple(position for position in positions if position.token.strip())
    found = [
        {label: position.likeliest[label] for label in labels if position.likeliest.get(label, 0.0) > 0.0}
        for position, labels in zip(positions, lists, strict=False)
    ]
    return found if len(found) == len(lists) and all(found) else []


def _filled(found: Mapping[str, float], labels: Collection[str]) -> dict[str, float]:
    least = max(_TINY, 0.5 * min(found.values()))
    return _normalised({label: found.get(label) or least for label in labels})


def check_labels(text: str, lists: Sequence[Collection[str]]) -> list[str]:
    """The label that a text names for each list, one a line.

    Raises:
        NoDecision: the text names more or fewer labels, or one that its list does not have.
    """
    labels = text.split()
    if len(labels) != len(lists) or any(label not in offered for label, offered in zip(labels, lists, strict=True)):
        raise NoDecision("answer_format", repr(text[:80]))
    return labels


def calibrated(measured: Mapping[str, float], bias: Mapping[str, float]) -> dict[str, float]:
    """``p(a) / b(a)``, renormalised; the bias is normalised over the offered labels first."""
    offered = _normalised({label: bias[label] for label in measured})
    least = _LEAST_BIAS / len(measured)
    return _normalised({label: value / max(offered[label], least) for label, value in measured.items()})


class LabelReader:
    """Reads the labels that an LLM answers, and measures its label bias, for every mission of an edge.

    A request has one or several lists of labels; its answer names one label of each list.
    """

    def __init__(self) -> None:
        self._bias = BoundedDict[_Question, list[dict[str, float]]](_MOST_BIASES)
        self._attempts: dict[_Question, int] = {}
        self._task: asyncio.Task[None] | None = None

    def bias(self, model: str | None, static: str, lists: int = 1) -> list[dict[str, float]] | None:
        """A model's bias under a static block, by list; None until it is measured."""
        return self._bias.get((model, static, lists))

    def read(self, completion: Completion, static: str, lists: Sequence[Collection[str]]) -> list[dict[str, float]]:
        """The labels' probabilities by list, calibrated once the bias is known; raises :class:`NoDecision`."""
        measured = probabilities(completion, lists)
        bias = self.bias(completion.model, static, len(lists))
        if bias is None or not _by_label(completion, lists):
            return measured
        return [calibrated(*pair) for pair in zip(measured, bias, strict=True)]

    def calibrate(
        self, ask: Ask, model: str | None, static: str, texts: Sequence[str], lists: Sequence[Sequence[str]]
    ) -> None:
        """Measure the bias of a model that gives probabilities in the background, unless it is known or under way.

        Args:
            ask: calls that model.
            texts: content-free user messages; without any there is nothing to measure.
            lists: every label that a request under this static block can offer, by list.
        """
        key = (model, static, len(lists))
        busy = self._task is not None and not self._task.done()
        if busy or not texts or key in self._bias or self._attempts.get(key, 0) >= _ATTEMPTS:
            return
        self._attempts[key] = self._attempts.get(key, 0) + 1
        self._task = asyncio.create_task(self._measure(ask, key, texts, lists), name="calibration")

    async def close(self) -> None:
        """Cancel the measurement."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _measure(self, ask: Ask, key: _Question, texts: Sequence[str], lists: Sequence[Sequence[str]]) -> None:
        try:
            async with asyncio.timeout(TIMEOUT_S):
                answers = [await ask(key[1], text, lists) for text in texts]
            measured = [probabilities(answer, lists) for answer in answers]
        except (NoDecision, TimeoutError) as error:
            log.warning("label bias not measured: %s", error)
            return
        if {answer.model for answer in answers} != {key[0]}:
            # Another server has answered some of them.
            return
        self._bias[key] = [
            {label: sum(answer[index][label] for answer in measured) / len(measured) for label in labels}
            for index, labels in enumerate(lists)
        ]
        if len(self._attempts) > 16 * _MOST_BIASES:
            self._attempts.clear()


def _normalised(values: Mapping[str, float]) -> dict[str, float]:
    total = sum(values.values())
    return {label: value / total for label, value in values.items()}
