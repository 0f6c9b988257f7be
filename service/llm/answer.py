"""The answer: its grammar for servers that can constrain, and the check that every answer must pass."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Sequence
from typing import Any, Literal

from shared.wire import Reason

Constraint = Literal["grammar", "structured_outputs", "json_schema", "none"]

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


def constrain_label(constraint: Constraint, labels: Sequence[str]) -> dict[str, Any]:
    """The request fields that hold a server to one of some labels, each a single token.

    OpenAI's ``json_schema`` could only name the label within an object, not in the first token: such a server is left
    free, and the labels are found among its likeliest tokens.
    """
    if constraint == "grammar":
        return {"grammar": f"root ::= {_alternatives(list(labels))}"}
    if constraint == "structured_outputs":
        return {"structured_outputs": {"choice": list(labels)}}
    return {}


def check_label(text: str, labels: Collection[str]) -> str:
    """The label that a text is.

    Raises:
        NoDecision: it is none of those offered.
    """
    label = text.strip()
    if label not in labels:
        raise NoDecision("answer_format", repr(text[:80]))
    return label


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


def check_answer(text: str, sensor_ids: Collection[int], velocities: int) -> tuple[int, int]:
    """Sensor ID and velocity, from plain text or the JSON object of :func:`json_schema`.

    Raises:
        NoDecision: extra text, a sensor that was not offered, or a velocity that does not exist.
    """
    sensor, velocity = _two_integers(text)
    if sensor not in sensor_ids:
        raise NoDecision("answer_sensor", repr(text[:80]))
    if not 0 <= velocity < velocities:
        raise NoDecision("answer_velocity", repr(text[:80]))
    return sensor, velocity


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
