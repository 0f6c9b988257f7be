"""The time of a flight of real UAVs, or of vehicles that a simulator moves faster."""

import asyncio
import time
from typing import Protocol


class Clock(Protocol):
    """Seconds of the mission since some instant."""

    def now(self) -> float:
        """The present time, seconds."""
        ...

    async def until(self, time_s: float) -> None:
        """Wait until then; not at all if it is over."""
        ...


class MissionClock:
    """The machine's clock, ``speedup`` times as fast."""

    def __init__(self, speedup: float = 1.0) -> None:
        self._speedup = speedup

    def now(self) -> float:
        """The present time, seconds."""
        return time.monotonic() * self._speedup

    async def until(self, time_s: float) -> None:
        """Wait until then."""
        await asyncio.sleep(max(0.0, time_s - self.now()) / self._speedup)
