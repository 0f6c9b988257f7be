"""Bytes for what the store keeps: MessagePack, with numpy arrays as an extension type. Reading it runs no code."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np

_ARRAY = 1


def pack(value: Any) -> bytes:
    """Bytes of nested dicts, lists, numbers, texts and arrays; raises ``TypeError`` for anything else."""
    packed: bytes = msgpack.packb(value, default=_default)
    return packed


def unpack(data: bytes) -> Any:
    """What was packed, with lists for tuples; raises ``ValueError`` for damaged bytes."""
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
