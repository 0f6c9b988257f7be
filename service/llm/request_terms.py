"""The form of request that a server accepts, learned from its refusals and from answers that were cut off.

OpenAI's reasoning models refuse ``max_tokens`` and name ``max_completion_tokens``, and accept no temperature but 1;
o1-mini and the chat templates of Gemma refuse the system role; vLLM limits ``top_logprobs`` by ``--max-logprobs``. Each
of them answers by a status of 400 or 422 and names the parameter in its message.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

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
# Tokens of thought in addition to an answer, tried one after the other.
_BUDGETS = (256, 1024, 4096, 16_384)


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

    def after_refusal(self, message: str, body: dict[str, Any]) -> RequestTerms | None:
        """These terms with the refused field renamed, lowered or dropped; None if the message names no such field.

        Args:
            message: the server's own words, with the parameter that it names.
            body: the request body to which these terms were applied.
        """
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

    def with_more_tokens(self, most: int) -> RequestTerms | None:
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
