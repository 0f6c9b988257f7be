"""Waiting until every vehicle flies its mission: this program neither arms nor takes off."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from field.errors import VehicleError
from field.vehicles.field_uav import FieldUav

POLL_S = 0.2


async def wait_for_missions(
    uavs: Sequence[FieldUav], wait_s: float, on_wait: Callable[[int, str], None] = lambda uav, why: None
) -> None:
    """Wait until each UAV is in the air and flies its mission.

    Args:
        wait_s: the longest wait, seconds.
        on_wait: called once for each new cause of the wait.

    Raises:
        VehicleError: after ``wait_s`` seconds one still does not; the text says why.
    """
    ends = time.monotonic() + wait_s
    reported: dict[int, str] = {}
    while True:
        await asyncio.gather(*(uav.update(POLL_S) for uav in uavs))
        waiting = {uav.index: (uav, uav.unavailable_reason) for uav in uavs if uav.unavailable_reason is not None}
        if not waiting:
            return
        for index, (uav, why) in waiting.items():
            uav.landed = False
            if why is not None and reported.get(index) != why:
                reported[index] = why
                on_wait(index, why)
            if time.monotonic() >= ends:
                raise VehicleError(
                    f"{uav.vehicle.name}: after {wait_s:g} s UAV {index} does not fly its mission: {why}; arm it, take "
                    "off and start the mission, or give a longer --wait-s"
                )
        await asyncio.sleep(POLL_S)
