"""What an LLM server answered: a text, what it cost, and how probable its tokens were."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from service.llm.answer_format import NoDecision
from service.llm.request_bodies import TOLD_TOKENS

_MOST_PLACES = 256


class NotUnderstood(NoDecision):
    """The server refused the request as it was put."""


class Unreachable(NoDecision):
    """Nobody listens at the address."""


@dataclass(frozen=True, slots=True)
class Place:
    """One token of an answer, and the probabilities of the likeliest tokens in its place, blanks stripped."""

    token: str
    likeliest: dict[str, float]

    def untempered(self, temperature: float) -> Place:
        """What the probabilities would be at temperature 1: ``q^T``, renormalised."""
        raised = {token: q**temperature for token, q in self.likeliest.items()}
        total = sum(raised.values())
        return Place(self.token, {token: p / total for token, p in raised.items()} if total else {})


@dataclass(frozen=True, slots=True)
class Completion:
    """An answer's text and the server's ``usage``; ``None`` where it said nothing.

    ``places`` are those of the text's tokens; empty where the server told no probabilities. ``model`` said it.
    """

    text: str
    prompt_tokens: int | None
    cached_tokens: int | None
    completion_tokens: int | None
    places: tuple[Place, ...] = ()
    model: str | None = None


def places_of(choice: Any) -> tuple[Place, ...]:
    """The answer's places as far as they can be read: OpenAI's ``top_logprobs``, or llama.cpp's ``top_probs``."""
    found: list[Place] = []
    try:
        for place in choice["logprobs"]["content"][:_MOST_PLACES]:
            likeliest = _probabilities(place.get("top_logprobs") or place.get("top_probs") or [])
            found.append(Place(str(place.get("token", "")), likeliest))
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        pass
    return tuple(found) if any(place.likeliest for place in found) else ()


def _probabilities(told: Any) -> dict[str, float]:
    found: dict[str, float] = {}
    for entry in told[: 4 * TOLD_TOKENS]:
        probability = entry["prob"] if "prob" in entry else math.exp(min(0.0, entry["logprob"]))
        # Neither holds for what is not a number.
        known = 0.0 <= probability <= 1.0 and not math.isnan(entry.get("logprob", 0.0))
        if isinstance(entry["token"], str) and known:
            token = entry["token"].strip()
            found[token] = min(1.0, found.get(token, 0.0) + float(probability))
    return found
