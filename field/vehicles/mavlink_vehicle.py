"""A vehicle over MAVLink, by MAVSDK 4 (extra ``mavlink``).

Three commands fly it: ``MAV_CMD_DO_CHANGE_SPEED``, and ``MAV_CMD_DO_SET_MODE`` with the modes hold and mission. None
arms, takes off, lands or has a position. ``MAV_CMD_SET_MESSAGE_INTERVAL`` asks for positions while none arrive.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

from field.errors import VehicleError
from field.vehicles.vehicle import FlightMode, VehicleState
from simulator.errors import UsageError
from simulator.sites.plans.mission_path import MissionItem

# MAVSDK notices a lost heartbeat after this time, too.
STALE_S = 3.0
# ArduPilot sends no position unasked: its stream rates are 0 until a ground station sets them (GCS_MAVLink_Parameters;
# MAVSDK-Python 637), and again after it has started anew. So positions are asked for after this time without one.
_ASK_S = 1.0
_POSITIONS_HZ = 4.0
_RELATIVE_FRAMES = {3, 6}
# The scale of a mission item's latitude and longitude.
_DEGREES = 1e-7


def require_mavsdk() -> None:
    """Raises ``ModuleNotFoundError`` without MAVSDK, and ``UsageError`` with one before version 4."""
    import mavsdk  # noqa: F401

    try:
        import mavsdk.asyncio  # noqa: F401
    except ModuleNotFoundError:
        raise UsageError(
            "the installed mavsdk is older than version 4; type: pip install --upgrade 'aic-vds[mavlink]'"
        ) from None


@asynccontextmanager
async def mavlink_vehicle(url: str, wait_s: float) -> AsyncIterator[MavlinkVehicle]:
    """The vehicle at a MAVLink connection, such as ``udpin://0.0.0.0:14540``; closes the connection at the end.

    Raises:
        UsageError: the text is no connection, or cannot be opened.
        VehicleError: no autopilot is heard within ``wait_s`` seconds.
    """
    from mavsdk.asyncio import Autopilot, ComponentType, Configuration, Mavsdk, MavsdkConnectionError

    _quiet()
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)) as mavsdk:
        try:
            await mavsdk.add_any_connection(url)
        except MavsdkConnectionError as error:
            raise UsageError(
                f"--mavlink {url}: {error}; write udpin://0.0.0.0:14540 to listen, udpout://HOST:PORT, tcpout://HOST:PORT"
                " or serial:///dev/ttyACM0:57600"
            ) from None
        system = await mavsdk.first_autopilot(timeout_s=wait_s)
        if system is None:
            raise VehicleError(
                f"--mavlink {url}: no autopilot was heard for {wait_s:g} s; does it send MAVLink to this address?"
            )
        vehicle = MavlinkVehicle(url, system, await system.autopilot_type() == Autopilot.ARDUPILOT)
        listening, ended = asyncio.create_task(vehicle.listen()), asyncio.Event()
        asking = asyncio.create_task(vehicle.ask_for_positions(ended))
        try:
            yield vehicle
        finally:
            listening.cancel()
            with suppress(asyncio.CancelledError):
                await listening
            # A request under way is in a thread, which needs the connection.
            ended.set()
            await asking


class MavlinkVehicle:
    """One vehicle; see :class:`field.vehicles.vehicle.Vehicle`.

    Args:
        name: for messages: its connection.
        system: of MAVSDK.
        home_is_first: whether the first item of its mission is its home, as in ArduPilot.
    """

    def __init__(self, name: str, system: Any, home_is_first: bool) -> None:
        from mavsdk.asyncio.plugins.action import ActionAsync
        from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
        from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

        self.name = name
        self._system, self._home_is_first = system, home_is_first
        self._telemetry, self._action, self._mission = (
            TelemetryAsync(system),
            ActionAsync(system),
            MissionRawAsync(system),
        )
        self._position: Any = None
        self._heard_s = -math.inf
        self._connected_s = time.monotonic()

    async def listen(self) -> None:
        """Take the positions as they arrive, until it is cancelled."""
        async for position in self._telemetry.subscribe_position():
            self._position, self._heard_s = position, time.monotonic()

    async def ask_for_positions(self, ended: asyncio.Event) -> None:
        """Ask for positions whenever none has come for a second, until the flight has ended.

        A denied or unanswered request is no failure: arriving positions show whether it took effect.
        """
        from mavsdk.asyncio import MavsdkError

        while not ended.is_set():
            with suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), _ASK_S)
            silent_s = time.monotonic() - max(self._heard_s, self._connected_s)
            if silent_s > _ASK_S and not ended.is_set():
                with suppress(MavsdkError):
                    await self._telemetry.set_rate_position(_POSITIONS_HZ)

    async def state(self) -> VehicleState:
        """The newest telemetry; a link or a position that was silent for three seconds counts as none."""
        fresh = time.monotonic() - self._heard_s < STALE_S
        at = self._position
        fixed = fresh and math.isfinite(at.latitude_deg) and math.isfinite(at.longitude_deg)
        return VehicleState(
            connected=bool(await self._system.is_connected()),
            armed=bool(await self._telemetry.armed()),
            mode=_mode(int(await self._telemetry.flight_mode())),
            position=(at.longitude_deg, at.latitude_deg) if fixed else None,
            height_m=at.relative_altitude_m if fixed else 0.0,
        )

    async def mission(self) -> list[MissionItem]:
        """The mission on board, without ArduPilot's home."""
        items = await self._command("give its mission", self._mission.download_mission())
        flown = items[1:] if self._home_is_first else items
        return [_item(item) for item in flown]

    async def set_speed(self, speed_m_s: float) -> None:
        """``MAV_CMD_DO_CHANGE_SPEED``, ground speed."""
        await self._command(f"fly at {speed_m_s:g} m/s", self._action.set_current_speed(speed_m_s))

    async def hold(self) -> None:
        """Mode hold."""
        await self._command("hold", self._mission.pause_mission())

    async def resume(self) -> None:
        """Mode mission."""
        await self._command("go on with its mission", self._mission.start_mission())

    async def _command(self, what: str, doing: Any) -> Any:
        from mavsdk.asyncio import MavsdkError

        try:
            return await doing
        except MavsdkError as error:
            result = getattr(error, "result", None)
            raise VehicleError(f"{self.name} did not {what}: {getattr(result, 'name', error)}") from None


def _mode(number: int) -> FlightMode:
    """The mode of MAVSDK's number."""
    names: dict[int, FlightMode] = {3: "hold", 4: "mission", 5: "landing", 6: "landing"}
    return names.get(number, "other")


def _item(item: Any) -> MissionItem:
    placed = item.x or item.y
    return MissionItem(
        where=f"item {item.seq}",
        number=item.seq,
        command=item.command,
        position=(item.y * _DEGREES, item.x * _DEGREES) if placed else None,
        altitude_m=item.z if item.frame in _RELATIVE_FRAMES else None,
        parameters=(item.param1, item.param2),
    )


def _quiet() -> None:
    """Keep what MAVSDK prints, such as every component that it discovers, out of the command's output."""
    from mavsdk.logging import log_subscribe

    log_subscribe(lambda level, message, file, line: True)
