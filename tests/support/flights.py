"""What the tests of flights over MAVLink share: a command's arguments, and the wait for a UAV's state."""

from __future__ import annotations

import asyncio
from pathlib import Path

from field.vehicles.field_uav import FieldUav
from tests.support.waiting import PATIENCE_S
from tests.support.world_folders import EXAMPLE

# A step takes half a second. The patience is for a busy machine; what a slow edge brings is not asked here.
QUICK = ("--speedup", "20", "--patience-s", "0.45", "--deadline-ms", "400")


def arguments(port: int, edge: str, out: Path, *more: str) -> list[str]:
    """Of `aicvds`, to fly one vehicle of the example's world."""
    connection = ("--mavlink", f"udpin://127.0.0.1:{port}", "--world", str(EXAMPLE))
    return ["fly", *connection, "--edge", edge, "--mission", "m", "--out", str(out), *QUICK, *more]


async def becomes(uav: FieldUav, away: str | None) -> None:
    """Read the telemetry until this is why the UAV gets no command."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await uav.update(0.1)
            if uav.unavailable_reason == away:
                return
            await asyncio.sleep(0.05)
