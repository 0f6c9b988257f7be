"""The answer: its grammar for servers that can constrain, and the check that every answer must pass."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Sequence
from typing import Any, Literal

from shared.actions import Action
from shared.reasons import Reason

Constraint = Literal["grammar", "structured_outputs", "json_schema", "none"]

_JOINED = r' "\n" '
_PLAIN = re.compile(r"([0-9]{1,5}) ([0-9]{1,2})")


class NoDecision(Exception):
    """The LLM gave no decision; ``reason`` says why, for the response and the metrics, ``str()`` what happened."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.reason: Reason = reason


def constrain(constraint: Constraint, sensor_ids: Sequence[int], velocities: int) -> dict[str, Any]:
    """The request fields that hold a server to ``sensor_id velocity``.

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
    """The request fields that hold a server to one label of each list, each a single token and on a line of its own.

    OpenAI's ``json_schema`` could only name a label within an object, not as a token of its own: such a server is left
    free, and the labels are found among its likeliest tokens.
    """
    if constraint == "grammar":
        choices = [_alternatives(list(labels)) for labels in lists]
        return {"grammar": "root ::= " + (choices[0] if len(choices) == 1 else _JOINED.join(f"({c})" for c in choices))}
    if constraint == "structured_outputs" and len(lists) == 1:
        return {"structured_outputs": {"choice": list(lists[0])}}
    if constraint == "structured_outputs":
        return {"structured_outputs": {"regex": r"\n".join(f"({'|'.join(labels)})" for labels in lists)}}
    return {}


def check_labels(text: str, lists: Sequence[Collection[str]]) -> list[str]:
    """The label of each list that a text names, one a line.

    Raises:
        NoDecision: there are more or fewer, or one is none of those offered.
    """
    labels = text.split()
    if len(labels) != len(lists) or any(label not in offered for label, offered in zip(labels, lists, strict=True)):
        raise NoDecision("answer_format", repr(text[:80]))
    return labels


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


def check_answer(text: str, sensor_ids: Collection[int], velocities: int) -> Action:
    """Sensor ID and velocity, from plain text or the JSON object of :func:`json_schema`.

    Raises:
        NoDecision: extra text, a sensor that was not offered, or a velocity that does not exist.
    """
    sensor, velocity = _two_integers(text)
    if sensor not in sensor_ids:
        raise NoDecision("answer_sensor", repr(text[:80]))
    if not 0 <= velocity < velocities:
        raise NoDecision("answer_velocity", repr(text[:80]))
    return Action(sensor, velocity)


def _two_integers(text: str) -> tuple[int, int]:
    stripped = text.strip()
    if plain := _PLAIN.fullmatch(stripped):
        return int(plain[1]), int(plain[2])
    if stripped.startswith("{"):
        try:
            answer = json.loads(stripped)
        except (ValueError, RecursionError):
            raise NoDecision("answer_format", repr(text[:80])) from None
        values = [answer.get(key) for key in ("sensor_id", "velocity")]
        if len(answer) == 2 and all(type(value) is int for value in values):
            return values[0], values[1]
    raise NoDecision("answer_format", repr(text[:80]))


def _alternatives(words: list[str]) -> str:
    return " | ".join(f'"{word}"' for word in words)
