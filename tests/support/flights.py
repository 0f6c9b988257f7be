"""Support for tests of flights over MAVLink: a command's arguments, and the wait for a UAV's state."""

from __future__ import annotations

import asyncio
from pathlib import Path

from field.vehicles.field_uav import FieldUav
from tests.support.waiting import PATIENCE_S
from tests.support.world_folders import EXAMPLE

# A step takes half a second. The long patience suits a busy machine: these tests do not cover a slow edge.
QUICK = ("--speedup", "20", "--patience-s", "0.45", "--deadline-ms", "400")


def arguments(port: int, edge: str, out: Path, *more: str) -> list[str]:
    """The arguments of `aicvds` that fly one vehicle of the example's world."""
    connection = ("--mavlink", f"udpin://127.0.0.1:{port}", "--world", str(EXAMPLE))
    return ["fly", *connection, "--edge", edge, "--mission", "m", "--out", str(out), *QUICK, *more]


async def wait_for_reason(uav: FieldUav, reason: str | None) -> None:
    """Read the telemetry until the UAV is unavailable for this reason, or available for None."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await uav.update(0.1)
            if uav.unavailable_reason == reason:
                return
            await asyncio.sleep(0.05)
