"""The sensor columns of a report with two sensors, one of them never heard."""

from __future__ import annotations

from typing import Any

COLUMNS: dict[str, list[Any]] = {
    "id": [3, 8],
    "x": [10.0, 20.5],
    "y": [0.0, 1.0],
    "queue": [4.0, None],
    "battery": [50.0, None],
    "channel_gain": [-80.0, None],
    "last_seen": [2, None],
}
