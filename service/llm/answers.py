"""An LLM server's answer: its text and token probabilities, the checks that it must pass, and its failures."""

import json
import re
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from shared.wire.reasons import Reason
from shared.world.step_rule import Action

_TWO_INTEGERS = re.compile(r"([0-9]{1,5}) ([0-9]{1,2})")


class NoDecision(Exception):
    """The LLM gave no decision.

    Attributes:
        reason: for the response and the metrics; ``str()`` has the details.
        url: of the server that gave none; empty for the embedded LLM, and where none was called.
    """

    url = ""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.reason: Reason = reason


class NotUnderstood(NoDecision):
    """The server refused a field of the request."""


class Unreachable(NoDecision):
    """No server accepts connections at the address."""


class Busy(NoDecision):
    """The server asks for a pause (RFC 9110, 10.2.3).

    Attributes:
        until: end of the pause, a moment of ``time.monotonic``.
    """

    def __init__(self, detail: str, until: float) -> None:
        super().__init__("llm_status", detail)
        self.until = until

    @property
    def pause_s(self) -> float:
        """Seconds of the pause that are left."""
        return max(0.0, self.until - time.monotonic())


@dataclass(frozen=True, slots=True)
class TokenPosition:
    """One position of an answer.

    Attributes:
        token: the token drawn there.
        likeliest: probabilities of the likeliest tokens there, without blanks around them.
        after_sampling: whether they are from after the server's samplers, as llama.cpp's ``top_probs``.
    """

    token: str
    likeliest: dict[str, float]
    after_sampling: bool = False


def raised(probabilities: Mapping[str, float], exponent: float) -> dict[str, float]:
    """``p ** exponent``, renormalised: above 1 nearer to a choice of the likeliest. Empty if all are 0."""
    powers = {token: p**exponent for token, p in probabilities.items()}
    total = sum(powers.values())
    return {token: p / total for token, p in powers.items()} if total else {}


@dataclass(frozen=True, slots=True)
class Completion:
    """A chat completion.

    Attributes:
        prompt_tokens: of the server's ``usage``, as ``cached_tokens`` and ``completion_tokens``; None if missing.
        positions: of the text's tokens; empty if the server gives no probabilities.
        model: name of the model that answered.
        url: of the server that answered; None for the embedded LLM.
        unfinished: whether the server stopped at its limit of tokens before the answer began.
    """

    text: str
    prompt_tokens: int | None
    cached_tokens: int | None
    completion_tokens: int | None
    positions: tuple[TokenPosition, ...] = ()
    model: str | None = None
    url: str | None = None
    unfinished: bool = False


def check_answer(text: str, sensor_ids: Collection[int], velocities: int) -> Action:
    """Sensor ID and velocity, from plain text or the JSON object of :func:`json_schema`.

    Raises:
        NoDecision: the text has another form, a sensor that was not offered, or a velocity that does not exist.
    """
    sensor, velocity = _two_integers(text)
    if sensor not in sensor_ids:
        raise NoDecision("answer_sensor", repr(text[:80]))
    if not 0 <= velocity < velocities:
        raise NoDecision("answer_velocity", repr(text[:80]))
    return Action(sensor, velocity)


def _two_integers(text: str) -> tuple[int, int]:
    stripped = text.strip()
    if plain := _TWO_INTEGERS.fullmatch(stripped):
        return int(plain[1]), int(plain[2])
    if stripped.startswith("{"):
        try:
            answer = json.loads(stripped)
        except (ValueError, RecursionError):
            raise NoDecision("answer_format", repr(text[:80])) from None
        values = [answer.get(key) for key in ("sensor_id", "velocity")]
        if all(type(value) is int for value in values):
            return values[0], values[1]
    raise NoDecision("answer_format", repr(text[:80]))
