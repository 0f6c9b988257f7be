"""The request bodies of chat completions, with the fields that constrain a server to the form of the answer."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

# The kinds of constraint that servers obey: llama.cpp's grammar, vLLM's structured outputs, OpenAI's JSON schema.
Constraint = Literal["grammar", "structured_outputs", "json_schema", "none"]

# The token probabilities that a server gives, from the best to the plainest: after sampling (llama.cpp alone), the 20
# likeliest (the most of OpenAI and vLLM), the 5 likeliest (the most of others), or none.
TokenProbabilities = Literal["sampled", "top_20", "top_5", "none"]
TOP_LOGPROBS = {"sampled": 20, "top_20": 20, "top_5": 5}
# The temperature at which llama.cpp draws several labels one after the other.
SEVERAL_LABELS_TEMPERATURE = 0.2
# Sensor IDs and number of velocities of the first request.
WARM_UP_CHOICES = ([0], 15)
_LABEL_SEPARATOR = r' "\n" '


@dataclass(frozen=True, slots=True)
class Rewriting:
    """A text to be rewritten as worked examples show.

    Attributes:
        examples: pairs of a text and its rewritten form.
        constrain: returns the request fields for the answer's form under a server's constraint, and others.
    """

    instruction: str
    examples: Sequence[tuple[str, str]]
    text: str
    constrain: Callable[[Constraint], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class WarmUp:
    """The first request: the server processes the static block before a decision has to wait for it.

    Attributes:
        labels: labels of the answer; None if the answer is a sensor and a velocity.
    """

    static: str
    user: str
    labels: list[str] | None


def chat_body(
    model: str | None, system: str, user: str, constraint: Constraint, sensor_ids: list[int], velocities: int
) -> dict[str, Any]:
    """The request body of one decision: greedy, short, and constrained to ``sensor_id velocity``.

    Strict servers refuse unknown fields. So llama.cpp's ``cache_prompt`` goes only to a server that obeys ``grammar``.
    """
    fields = constrain(constraint, sensor_ids, velocities)
    if constraint == "grammar":
        fields["cache_prompt"] = True
    return _body(
        model, [_message("system", system), _message("user", user)], 32 if constraint == "json_schema" else 12, fields
    )


def label_body(
    model: str | None,
    system: str,
    user: str,
    constraint: Constraint,
    lists: Sequence[Sequence[str]],
    logprobs: TokenProbabilities = "sampled",
) -> dict[str, Any]:
    """The request body for one label of each list, with the likeliest tokens' probabilities.

    By default llama.cpp gives its probabilities from before the grammar. After sampling at temperature 0 all but one
    are 0. So it samples at temperature 1 without cutting any token off: the text is a draw. llama.cpp applies the
    grammar only after a first draw that violates it. The probabilities are among the labels then, and among all tokens
    otherwise, so the caller renormalises them. The probabilities of a later label depend on the labels drawn before it.
    So several labels are drawn at a low temperature, nearly always the likeliest, which
    :meth:`TokenPosition.untempered` undoes.
    """
    fields = constrain_labels(constraint, lists)
    if constraint == "grammar":
        fields["cache_prompt"] = True
    if logprobs != "none":
        fields |= {"logprobs": True, "top_logprobs": TOP_LOGPROBS[logprobs]}
        if logprobs == "sampled" and constraint == "grammar":
            fields |= {"post_sampling_probs": True, "samplers": ["temperature"]}
            fields["temperature"] = 1.0 if len(lists) == 1 else SEVERAL_LABELS_TEMPERATURE
    # A token for each label, and one for each end of a line between them.
    return _body(model, [_message("system", system), _message("user", user)], 2 * len(lists) - 1, fields)


def rewriting_body(
    model: str | None, wanted: Rewriting, constraint: dict[str, Any], temperature: float, seed: int
) -> dict[str, Any]:
    """The request body for rewriting a text; the examples appear as messages of the conversation.

    Args:
        constraint: the fields that constrain the server to the answer's form.
    """
    messages = [_message("system", wanted.instruction)]
    for text, rewritten in wanted.examples:
        messages += [_message("user", text), _message("assistant", rewritten)]
    return _body(
        model, [*messages, _message("user", wanted.text)], 128, {"temperature": temperature, "seed": seed, **constraint}
    )


def warm_up_body(
    model: str | None, first: WarmUp, constraint: Constraint, logprobs: TokenProbabilities
) -> dict[str, Any]:
    """The request body of a server's first request."""
    if first.labels is None:
        return chat_body(model, first.static, first.user, constraint, *WARM_UP_CHOICES)
    return label_body(model, first.static, first.user, constraint, [first.labels], logprobs)


def constrain(constraint: Constraint, sensor_ids: Sequence[int], velocities: int) -> dict[str, Any]:
    """The request fields that constrain a server to ``sensor_id velocity``.

    Args:
        sensor_ids: the admissible sensors.
        velocities: number of velocity levels, 0..velocities - 1.
    """
    sensors = [str(i) for i in sensor_ids]
    levels = [str(v) for v in range(velocities)]
    if constraint == "grammar":
        return {"grammar": f'root ::= ({_alternatives(sensors)}) " " ({_alternatives(levels)})'}
    if constraint == "structured_outputs":
        return {"structured_outputs": {"regex": f"({'|'.join(sensors)}) ({'|'.join(levels)})"}}
    if constraint == "json_schema":
        return {"response_format": json_schema(list(sensor_ids), list(range(velocities)))}
    return {}


def constrain_labels(constraint: Constraint, lists: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The request fields that constrain a server to one label of each list, each a single token on its own line.

    OpenAI's ``json_schema`` could only name a label within an object, not as a token of its own. Such a server is not
    constrained, and the labels are found among its likeliest tokens.
    """
    if constraint == "grammar":
        choices = [_alternatives(labels) for labels in lists]
        root = choices[0] if len(choices) == 1 else _LABEL_SEPARATOR.join(f"({choice})" for choice in choices)
        return {"grammar": f"root ::= {root}"}
    if constraint == "structured_outputs" and len(lists) == 1:
        return {"structured_outputs": {"choice": list(lists[0])}}
    if constraint == "structured_outputs":
        return {"structured_outputs": {"regex": r"\n".join(f"({'|'.join(labels)})" for labels in lists)}}
    return {}


def json_schema(sensor_ids: list[int], velocities: list[int]) -> dict[str, Any]:
    """OpenAI's ``response_format`` for ``{"sensor_id": ..., "velocity": ...}``."""
    schema = {
        "type": "object",
        "properties": {
            "sensor_id": {"type": "integer", "enum": sensor_ids},
            "velocity": {"type": "integer", "enum": velocities},
        },
        "required": ["sensor_id", "velocity"],
        "additionalProperties": False,
    }
    return {"type": "json_schema", "json_schema": {"name": "decision", "strict": True, "schema": schema}}


def _message(role: str, content: str) -> dict[str, str]:
    return {"role": role, "content": content}


def _body(
    model: str | None, messages: Sequence[dict[str, str]], max_tokens: int, fields: dict[str, Any]
) -> dict[str, Any]:
    """A request body, greedy unless the further fields differ."""
    body: dict[str, Any] = {"messages": list(messages), "temperature": 0, "max_tokens": max_tokens, "stream": False}
    return body | fields | ({"model": model} if model else {})


def _alternatives(texts: Sequence[str]) -> str:
    return " | ".join(f'"{text}"' for text in texts)
