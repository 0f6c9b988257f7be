"""The request bodies of chat completions: what an LLM server is asked, and how it is held to the answer's form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from service.llm.answer_format import Constraint, constrain, constrain_labels

# The most likely tokens that OpenAI and vLLM tell.
TOLD_TOKENS = 20
# The temperature at which several labels are drawn one after the other.
_COOL = 0.2


@dataclass(frozen=True, slots=True)
class Rewriting:
    """A text to be rewritten, after worked examples of texts and what became of them.

    ``constrain`` gives the request fields that hold a server to the form of the answer, by what it obeys.
    """

    instruction: str
    examples: Sequence[tuple[str, str]]
    text: str
    constrain: Callable[[Constraint], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class WarmUp:
    """A first question, so that the server has read the static block before a decision pays for it.

    ``labels`` are what it is answered by; None where it is answered by a sensor and a velocity.
    """

    static: str
    user: str
    labels: list[str] | None


def chat_body(
    model: str | None, system: str, user: str, constraint: Constraint, sensor_ids: list[int], velocities: int
) -> dict[str, Any]:
    """The request body of one decision: greedy, short, and held to the answer's form where the server can.

    ``cache_prompt`` is llama.cpp's; it is sent only to a server that understood llama.cpp's ``grammar``, because
    strict servers refuse fields they do not know.
    """
    body: dict[str, Any] = {
        "messages": [{"role": "system", "content": system}, {"role": "user", "content": user}],
        "temperature": 0,
        "max_tokens": 32 if constraint == "json_schema" else 12,
        "stream": False,
        **constrain(constraint, sensor_ids, velocities),
    }
    if model:
        body["model"] = model
    if constraint == "grammar":
        body["cache_prompt"] = True
    return body


def label_body(
    model: str | None,
    system: str,
    user: str,
    constraint: Constraint,
    lists: Sequence[Sequence[str]],
    logprobs: bool = True,
) -> dict[str, Any]:
    """The request body for one label of each list, with the likeliest tokens' probabilities if ``logprobs``.

    llama.cpp tells its probabilities from before the grammar unless asked for those after sampling; after sampling at
    temperature 0 all but one are 0. So it samples at temperature 1 with nothing cut off: the text is then a draw, and
    the probabilities are exactly the model's among the labels. A later label is told given those drawn before it; so of
    several it draws at a low temperature, nearly always the likeliest, and :meth:`Place.untempered` undoes that.
    """
    body: dict[str, Any] = {
        "messages": [{"role": "system", "content": system}, {"role": "user", "content": user}],
        "temperature": 0,
        # A token a label, and one for each end of a line between them.
        "max_tokens": 2 * len(lists) - 1,
        "stream": False,
        **constrain_labels(constraint, lists),
    }
    if model:
        body["model"] = model
    if constraint == "grammar":
        body["cache_prompt"] = True
    if logprobs:
        body |= {"logprobs": True, "top_logprobs": TOLD_TOKENS}
        if constraint == "grammar":
            body |= {"post_sampling_probs": True, "samplers": ["temperature"]}
            body["temperature"] = draw_temperature(lists)
    return body


def rewriting_body(
    model: str | None,
    instruction: str,
    examples: Sequence[tuple[str, str]],
    text: str,
    held: dict[str, Any],
    temperature: float,
    seed: int,
) -> dict[str, Any]:
    """The request body for rewriting a text as the examples are, which are shown as turns of the conversation.

    Args:
        held: the fields that hold the server to the answer's form.
    """
    turns = [
        {"role": role, "content": content}
        for example in examples
        for role, content in zip(("user", "assistant"), example, strict=True)
    ]
    body: dict[str, Any] = {
        "messages": [{"role": "system", "content": instruction}, *turns, {"role": "user", "content": text}],
        "temperature": temperature,
        "seed": seed,
        "max_tokens": 128,
        "stream": False,
        **held,
    }
    if model:
        body["model"] = model
    return body


def draw_temperature(lists: Sequence[Sequence[str]]) -> float:
    """At which llama.cpp draws the labels of so many lists."""
    return 1.0 if len(lists) == 1 else _COOL


def warm_up_body(model: str | None, first: WarmUp, constraint: Constraint, logprobs: bool) -> dict[str, Any]:
    """The request body of a server's first question."""
    if first.labels is None:
        return chat_body(model, first.static, first.user, constraint, [0], 15)
    return label_body(model, first.static, first.user, constraint, [first.labels], logprobs)
