"""The request bodies of chat completions, with the fields that constrain a server to the form of the answer."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
# A message about the prompt's length may name a parameter that is not the fault.
_ABOUT_LENGTH = re.compile(r"context.{0,20}(length|size|window)|too (large|long)|exceed", re.IGNORECASE)
_SYSTEM_ROLE = re.compile(
    r"system (role|message|prompt|instruction)|developer instruction|'system'|messages\[0\]\.role|roles must alternate",
    re.IGNORECASE,
)
# Azure's o-series and GPT-5 want 16 tokens or more (dotnet/extensions 6945), or as many as the answer takes.
_TOO_FEW = re.compile(r"tokens.*(below minimum|>= ?\d|at least \d)|higher max_tokens", re.IGNORECASE | re.DOTALL)
# Alibaba's thinking models answer in streams alone (supersonic 2355).
_STREAMS_ONLY = re.compile(r"non-stream|stream ?= ?false|only supports? stream|stream mode", re.IGNORECASE)
# Of an object that a small model spreads over lines, as SmolLM2 behind llama.cpp does with 62.
_JSON_TOKENS = 128
# Tokens of thought in addition to an answer, tried one after the other.
_BUDGETS = (256, 1024, 4096, 16_384)


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
    tokens = _JSON_TOKENS if constraint == "json_schema" else 12
    return _body(model, [_message("system", system), _message("user", user)], tokens, fields)


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
    :func:`service.llm.answers.raised` undoes.
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
    fields = {"sensor_id": sensor_ids, "velocity": velocities}
    properties = {name: {"type": "integer", "enum": allowed} for name, allowed in fields.items()}
    schema = {"type": "object", "properties": properties, "required": [*fields], "additionalProperties": False}
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


@dataclass(frozen=True, slots=True)
class RequestExtras:
    """The operator's additions to each request.

    Attributes:
        body: further fields of a completion's body; they replace those of the same name.
        headers: further headers.
        query: further parameters of each URL.
        most_tokens: most tokens of thought in addition to an answer.
    """

    body: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    query: Mapping[str, str] = field(default_factory=dict)
    most_tokens: int = 0


@dataclass(frozen=True, slots=True)
class RequestTerms:
    """Changes of a request body that a server demands.

    Attributes:
        max_tokens: the field that limits an answer's tokens.
        temperature: whether the temperature can be set.
        seed: whether the seed can be set.
        system_role: whether messages may have the system role; else the first user message begins with its text.
        top_logprobs: most token probabilities of a position; 0: the server gives none.
        more_tokens: tokens of thought in addition to the answer's.
        stream: whether the answer must come as events.
    """

    max_tokens: Literal["max_tokens", "max_completion_tokens"] = "max_tokens"
    temperature: bool = True
    seed: bool = True
    system_role: bool = True
    top_logprobs: int = 20
    more_tokens: int = 0
    stream: bool = False

    def applied(self, body: dict[str, Any]) -> dict[str, Any]:
        """A request body with these changes; the given one is left alone."""
        if self == _USUAL:
            return body
        changed = body | {"stream": self.stream}
        changed[self.max_tokens] = changed.pop("max_tokens") + self.more_tokens
        if not self.temperature:
            changed.pop("temperature", None)
        if not self.seed:
            changed.pop("seed", None)
        if "top_logprobs" in changed:
            changed["top_logprobs"] = min(changed["top_logprobs"], self.top_logprobs)
            if not self.top_logprobs:
                del changed["top_logprobs"], changed["logprobs"]
        if not self.system_role:
            changed["messages"] = _folded(changed["messages"])
        return changed

    def after_refusal(self, message: str, body: dict[str, Any]) -> "RequestTerms | None":
        """These terms with the refused field renamed, lowered or dropped; None if the message names no such field.

        Args:
            message: the server's own words, with the parameter that it names.
            body: the request body to which these terms were applied.
        """
        message = message.lower()
        if _ABOUT_LENGTH.search(message):
            return None
        if _TOO_FEW.search(message) and not self.more_tokens:
            return replace(self, more_tokens=_BUDGETS[0])
        if _STREAMS_ONLY.search(message) and not self.stream:
            return replace(self, stream=True)
        if "logprobs" in message and "top_logprobs" in body and self.top_logprobs:
            return replace(self, top_logprobs=5 if self.top_logprobs > 5 else 0)
        if "max_tokens" in message and self.max_tokens == "max_tokens":
            return replace(self, max_tokens="max_completion_tokens")
        if "temperature" in message and "temperature" in body and self.temperature:
            return replace(self, temperature=False)
        if re.search(r"\bseed\b", message) and "seed" in body and self.seed:
            return replace(self, seed=False)
        if self.system_role and _SYSTEM_ROLE.search(message):
            return replace(self, system_role=False)
        return None

    def __str__(self) -> str:
        """The changes in words; empty if there are none."""
        changes = [
            (self.max_tokens != "max_tokens", self.max_tokens),
            (not self.temperature, "no temperature"),
            (not self.seed, "no seed"),
            (not self.system_role, "no system role"),
            (self.top_logprobs < _USUAL.top_logprobs, f"{self.top_logprobs} token probabilities"),
            (self.more_tokens > 0, f"{self.more_tokens} tokens of thought"),
            (self.stream, "streams"),
        ]
        return ", ".join(text for changed, text in changes if changed)

    def with_more_tokens(self, most: int) -> "RequestTerms | None":
        """These terms with the next larger number of tokens for thought; None if that would be more than ``most``."""
        more = next((budget for budget in (*_BUDGETS, most) if self.more_tokens < budget <= most), None)
        return None if more is None else replace(self, more_tokens=more)


_USUAL = RequestTerms()


def _folded(messages: list[dict[str, str]]) -> list[dict[str, str]]:
    """Messages whose first user message begins with the system message's text."""
    system = "\n\n".join(message["content"] for message in messages if message["role"] == "system")
    others = [dict(message) for message in messages if message["role"] != "system"]
    others[0]["content"] = f"{system}\n\n{others[0]['content']}"
    return others
