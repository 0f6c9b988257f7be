"""A vehicle over MAVLink, by MAVSDK 4 (extra ``mavlink``).

``MAV_CMD_DO_CHANGE_SPEED`` sets its speed. It waits and goes on by ``MAV_CMD_DO_PAUSE_CONTINUE`` on ArduPilot, and by
``MAV_CMD_DO_SET_MODE`` with the modes hold and mission elsewhere. None arms, takes off, lands or has a position.
``MAV_CMD_SET_MESSAGE_INTERVAL`` asks for positions while none arrive, for the landed state and the battery.
"""

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from field.errors import Unanswered, VehicleError
from shared.world.scenario import Point
from simulator.errors import UsageError
from simulator.sites.plans.mission_path import MissionItem

# `mission`: it flies its uploaded mission; `hold`: it hovers or circles in place; `returning`: to where it took off.
FlightMode = Literal["mission", "hold", "landing", "returning", "other"]
# MAVSDK notices a lost heartbeat after this time, too.
STALE_S = 3.0
# ArduPilot sends no position unasked: its stream rates are 0 until a ground station sets them (GCS_MAVLink_Parameters;
# MAVSDK-Python 637), and again after it has started anew. So positions are asked for after this time without one.
_ASK_S = 1.0
_POSITIONS_HZ, _SLOW_HZ = 10.0, 1.0
# MAVSDK's own system ID unless another is asked for, and its number of a vehicle on the ground.
_SYSTEM_ID, _ON_GROUND = 1, 1
_PAUSE_CONTINUE, _UNSUPPORTED = 193, 3
_RELATIVE_FRAMES = {3, 6}
# The scale of a mission item's latitude and longitude.
_DEGREES = 1e-7


@dataclass(frozen=True)
class VehicleState:
    """The newest telemetry of a vehicle.

    Attributes:
        connected: whether heartbeats arrive.
        armed: as the autopilot says; ``None`` before its first heartbeat.
        mode: the autopilot's flight mode.
        position: longitude and latitude, degrees; ``None`` without a fix, and while none arrives.
        height_m: above the autopilot's home, which may be another place than that of its take-off.
        in_air: the autopilot's landed state; ``None`` where it says none.
        speed_m_s: over the ground; ``None`` where the autopilot says none.
        battery_percent: that is left; ``None`` where the autopilot says none.
    """

    connected: bool
    armed: bool | None
    mode: FlightMode
    position: Point | None
    height_m: float = 0.0
    in_air: bool | None = None
    speed_m_s: float | None = None
    battery_percent: float | None = None


class Vehicle(Protocol):
    """A vehicle with an autopilot that has a mission. The commands are a speed, wait, and go on.

    Every method may raise :class:`field.errors.VehicleError`.

    Attributes:
        name: for messages.
        waits_in_mission: whether the mode stays ``mission`` while it waits.
    """

    name: str
    waits_in_mission: bool

    async def state(self) -> VehicleState:
        """The newest telemetry; never waits for the vehicle."""

    async def mission(self) -> list[MissionItem]:
        """The mission on board."""

    async def set_speed(self, speed_m_s: float) -> None:
        """Fly along the mission at this ground speed, above 0."""

    async def hold(self) -> None:
        """Wait in place, in the mission."""

    async def resume(self) -> None:
        """Go on with the mission."""


def require_mavsdk() -> None:
    """Raises ``ModuleNotFoundError`` without MAVSDK, and ``UsageError`` with one before version 4."""
    import mavsdk

    try:
        import mavsdk.asyncio  # noqa: F401
    except ModuleNotFoundError:
        raise UsageError(
            "the installed mavsdk is older than version 4; type: pip install --upgrade 'aic-vds[mavlink]'"
        ) from None


@asynccontextmanager
async def mavlink_vehicle(url: str, wait_s: float, system_id: int | None = None) -> "AsyncIterator[MavlinkVehicle]":
    """The vehicle at a MAVLink connection, such as ``udpin://0.0.0.0:14540``; closes the connection at the end.

    Args:
        wait_s: for its first heartbeat, seconds.
        system_id: of this program; ``None``: the vehicle's, which ArduPilot obeys even where ``MAV_OPTIONS`` lets it
            obey its own ground station only.

    Raises:
        UsageError: the text is no connection, or cannot be opened.
        VehicleError: no autopilot is heard within ``wait_s`` seconds.
    """
    from mavsdk.asyncio import Autopilot

    _quiet()
    async with AsyncExitStack() as stack:
        system = await stack.enter_async_context(_connected(url, wait_s, system_id or _SYSTEM_ID))
        number = await system.get_system_id()
        if system_id is None and number != _SYSTEM_ID:
            # MAVSDK takes its own ID at the start, before it hears the vehicle's.
            await stack.aclose()
            system = await stack.enter_async_context(_connected(url, wait_s, number))
        vehicle = MavlinkVehicle(url, system, number, await system.autopilot_type() == Autopilot.ARDUPILOT)
        listening, ended = asyncio.create_task(vehicle.listen()), asyncio.Event()
        asking = asyncio.create_task(vehicle.ask_for_telemetry(ended))
        try:
            yield vehicle
        finally:
            listening.cancel()
            with suppress(asyncio.CancelledError):
                await listening
            # A request under way is in a thread, which needs the connection.
            ended.set()
            await asking


@asynccontextmanager
async def _connected(url: str, wait_s: float, system_id: int) -> AsyncIterator[Any]:
    """MAVSDK's system of the first autopilot at a connection; raises as :func:`mavlink_vehicle`."""
    from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, MavsdkConnectionError

    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    configuration.system_id = system_id
    async with Mavsdk(configuration) as mavsdk:
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
        yield system


class MavlinkVehicle:
    """One vehicle; see :class:`field.vehicles.mavlink_vehicle.Vehicle`.

    Args:
        name: for messages: its connection.
        system: of MAVSDK.
        system_id: of the vehicle.
        ardupilot: whether it is one: the first item of its mission is its home, and it may pause in its mission.
    """

    def __init__(self, name: str, system: Any, system_id: int, ardupilot: bool) -> None:
        from mavsdk.asyncio.plugins.action import ActionAsync
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
        from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
        from mavsdk.asyncio.plugins.param import ParamAsync
        from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

        self.name, self.waits_in_mission = name, False
        self._system, self._system_id, self._ardupilot = system, system_id, ardupilot
        self._telemetry, self._action = TelemetryAsync(system), ActionAsync(system)
        self._mission, self._parameters = MissionRawAsync(system), ParamAsync(system)
        self._direct = MavlinkDirectAsync(system)
        self._position: Any = None
        self._armed: bool | None = None
        self._heard_s = -math.inf
        self._connected_s = time.monotonic()

    async def listen(self) -> None:
        """Take the positions and heartbeats as they arrive, until it is cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._take_positions())
            tasks.create_task(self._take_heartbeats())

    async def _take_positions(self) -> None:
        async for position in self._telemetry.subscribe_position():
            self._position, self._heard_s = position, time.monotonic()

    async def _take_heartbeats(self) -> None:
        async for armed in self._telemetry.subscribe_armed():
            self._armed = bool(armed)

    async def ask_for_telemetry(self, ended: asyncio.Event) -> None:
        """Ask for positions whenever none has come for a second, until the flight has ended.

        With them it asks for the landed state and the battery, and once where positions come unasked but one of these
        does not. A denied or unanswered request is no failure: what arrives shows whether it took effect.
        """
        from mavsdk.asyncio import MavsdkError

        first = True
        while not ended.is_set():
            with suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), _ASK_S)
            silent = time.monotonic() - max(self._heard_s, self._connected_s) > _ASK_S
            if silent and not ended.is_set():
                with suppress(MavsdkError):
                    await self._telemetry.set_rate_position(_POSITIONS_HZ)
            unknown = not await self._telemetry.landed_state() or await self._battery_percent() is None
            if (silent or (first and unknown)) and not ended.is_set():
                for ask in (self._telemetry.set_rate_landed_state, self._telemetry.set_rate_battery):
                    with suppress(MavsdkError):
                        await ask(_SLOW_HZ)
            first = False

    async def state(self) -> VehicleState:
        """The newest telemetry; a link or a position that was silent for three seconds counts as none."""
        fresh = time.monotonic() - self._heard_s < STALE_S
        at = self._position
        fixed = fresh and math.isfinite(at.latitude_deg) and math.isfinite(at.longitude_deg)
        landed, flown = int(await self._telemetry.landed_state()), await self._telemetry.velocity_ned()
        return VehicleState(
            connected=bool(await self._system.is_connected()),
            armed=self._armed,
            mode=_mode(int(await self._telemetry.flight_mode())),
            position=(at.longitude_deg, at.latitude_deg) if fixed else None,
            height_m=at.relative_altitude_m if fixed else 0.0,
            in_air=landed != _ON_GROUND if landed else None,
            speed_m_s=math.hypot(flown.north_m_s, flown.east_m_s) if fixed else None,
            battery_percent=await self._battery_percent(),
        )

    async def _battery_percent(self) -> float | None:
        # Not a number before the first message, and for an autopilot that does not know it.
        left = float((await self._telemetry.battery()).remaining_percent)
        return left if 0 <= left <= 100 else None

    async def mission(self) -> list[MissionItem]:
        """The mission on board, without ArduPilot's home."""
        items = await self._command("give its mission", self._mission.download_mission())
        return [_item(item) for item in items[1 if self._ardupilot else 0 :]]

    async def set_speed(self, speed_m_s: float) -> None:
        """``MAV_CMD_DO_CHANGE_SPEED``, ground speed."""
        await self._command(f"fly at {speed_m_s:g} m/s", self._action.set_current_speed(speed_m_s))

    async def hold(self) -> None:
        """Pause in the mission where the autopilot can, else mode hold.

        With ``MIS_RESTART`` 1 an ArduPilot begins its mission again after mode hold, so it is not sent there.
        """
        # Until it denies it: its answer may be lost.
        self.waits_in_mission = self._ardupilot
        if self._ardupilot and await self._pause(True):
            return
        self.waits_in_mission = False
        if self._ardupilot and await self._command("say MIS_RESTART", self._parameters.get_param_int("MIS_RESTART")):
            raise VehicleError(f"{self.name} did not hold: its MIS_RESTART begins the mission again; set it to 0")
        await self._command("hold", self._mission.pause_mission())

    async def resume(self) -> None:
        """Go on from the pause, or mode mission."""
        if not self.waits_in_mission:
            await self._command("go on with its mission", self._mission.start_mission())
        elif not await self._pause(False):
            raise VehicleError(f"{self.name} did not go on with its mission: UNSUPPORTED")
        self.waits_in_mission = False

    async def _pause(self, pauses: bool) -> bool:
        """``MAV_CMD_DO_PAUSE_CONTINUE``; returns whether the autopilot knows it, raises if it fails or is denied."""
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkMessage

        target = {"target_system": self._system_id, "target_component": 1}
        fields = target | {"command": _PAUSE_CONTINUE, "confirmation": 0, "param1": int(not pauses)}
        fields |= {f"param{n}": 0 for n in range(2, 8)}
        message = MavlinkMessage("COMMAND_LONG", 0, 0, self._system_id, 1, json.dumps(fields))
        what = "hold" if pauses else "go on with its mission"
        answer = json.loads((await self._command(what, self._direct.send_command(message))).fields_json)["result"]
        if answer not in (0, _UNSUPPORTED):
            self.waits_in_mission = not pauses
            raise VehicleError(f"{self.name} did not {what}: MAV_RESULT {answer}")
        return bool(answer == 0)

    async def _command(self, what: str, doing: Any) -> Any:
        from mavsdk.asyncio import MavsdkError

        try:
            return await doing
        except MavsdkError as error:
            result = getattr(getattr(error, "result", None), "name", str(error))
            kind = Unanswered if result == "TIMEOUT" else VehicleError
            raise kind(f"{self.name} did not {what}: {result}") from None


def _mode(number: int) -> FlightMode:
    """The mode of MAVSDK's number."""
    names: dict[int, FlightMode] = {3: "hold", 4: "mission", 5: "returning", 6: "landing"}
    return names.get(number, "other")


def _item(item: Any) -> MissionItem:
    placed = item.x or item.y
    return MissionItem(
        where=f"item {item.seq}",
        number=item.seq,
        command=item.command,
        position=(item.y * _DEGREES, item.x * _DEGREES) if placed else None,
        altitude_m=item.z if item.frame in _RELATIVE_FRAMES and math.isfinite(item.z) else None,
        parameters=(item.param1, item.param2),
        frame=item.frame,
        autocontinue=bool(item.autocontinue),
    )


def _quiet() -> None:
    """Keep what MAVSDK prints, such as every component that it discovers, out of the command's output."""
    from mavsdk.logging import log_subscribe

    log_subscribe(lambda level, message, file, line: True)
