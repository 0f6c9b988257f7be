"""The store's file format: events and states as MessagePack, with numpy arrays as an extension type.

Reading it runs no code.
"""

from __future__ import annotations

from typing import Any, Literal

import msgpack
import numpy as np

from service.learning.trust import Advice
from service.mission.decisions import Pending
from service.mission.events import AdviserReport, Decided, Event, Guided, Reported, Settled
from service.mission.idempotency import Answered
from shared.wire import Outcome, UavState

# The extension type of an array.
_ARRAY = 1
# A request also carries an outcome, which is an event of its own, and its encoding, which is of no use later.
_REPORT = set(UavState.model_fields) - {"outcome", "base", "uplink"}
# The fields of an outcome that change a mission's state.
_OUTCOME = set(Outcome.model_fields) - {"round_trip_ms"}

Kind = Literal["reported", "decided", "settled", "guided", "answered"]


def encode(event: Event) -> tuple[Kind, bytes]:
    """An event's kind, and its body as bytes."""
    match event:
        case Reported(step, uav):
            return "reported", pack([step, uav.model_dump(include=_REPORT, exclude_defaults=True)])
        case Decided(decision, attempt, report):
            packed = None if report is None else [report.model, report.advice.state_dict()]
            return "decided", pack([decision.state_dict(), attempt, packed])
        case Settled(outcome, used_for_training):
            return "settled", pack([outcome.model_dump(include=_OUTCOME), used_for_training])
        case Guided(state):
            return "guided", pack(state)
        case Answered(key, digest, answer):
            return "answered", pack([key, digest, answer])


def decode(kind: str, data: bytes) -> Event:
    """The event of a kind and a body; raises ``ValueError`` for damaged or unknown ones."""
    try:
        body = unpack(data)
        match kind:
            case "reported":
                return Reported(body[0], UavState.model_validate(body[1]))
            case "decided":
                report = None if body[2] is None else AdviserReport(body[2][0], Advice(**body[2][1]))
                return Decided(Pending.of(body[0]), body[1], report)
            case "settled":
                return Settled(Outcome.model_validate(body[0]), body[1])
            case "guided":
                return Guided(body)
            case "answered":
                return Answered(*body)
    except (AttributeError, IndexError, KeyError, TypeError) as damaged:
        raise ValueError(f"damaged event {kind}: {damaged}") from damaged
    raise ValueError(f"unknown event {kind}")


def pack(value: Any) -> bytes:
    """Bytes of nested dicts, lists, numbers, strings and arrays; raises ``TypeError`` for anything else."""
    packed: bytes = msgpack.packb(value, default=_default)
    return packed


def unpack(data: bytes) -> Any:
    """The value that was packed, with lists for tuples; raises ``ValueError`` for damaged bytes."""
    try:
        return msgpack.unpackb(data, ext_hook=_array, strict_map_key=False)
    except (TypeError, msgpack.UnpackException) as damaged:
        raise ValueError(f"damaged bytes: {damaged}") from damaged


def _default(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return msgpack.ExtType(_ARRAY, msgpack.packb((value.dtype.str, value.shape, value.tobytes())))
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _array(code: int, data: bytes) -> Any:
    if code != _ARRAY:
        raise ValueError(f"unknown extension type {code}")
    dtype, shape, raw = msgpack.unpackb(data)
    if np.dtype(dtype).hasobject:
        raise ValueError(f"an array of {dtype} cannot be read")
    return np.frombuffer(raw, dtype=dtype).reshape(shape).copy()
