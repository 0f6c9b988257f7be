"""A MAVLink peer made with pymavlink alone: an implementation of the protocol that shares nothing with MAVSDK.

As an ArduPilot it behaves as observed with a real ArduCopter (../shared/REALITY.md, table B; by row), and as PX4 does
where that differs.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

os.environ.setdefault("MAVLINK20", "1")

from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from tests.support.airframe import GROUND_M, HEIGHT_M, Airframe, Item

TICK_S, HEARTBEAT_S = 0.02, 0.2
SPEED, SET_MODE = mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.MAV_CMD_DO_SET_MODE
PAUSE, START = mavlink.MAV_CMD_DO_PAUSE_CONTINUE, mavlink.MAV_CMD_MISSION_START
POSITION, LANDED = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
PX4, ARDUPILOT = mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
# PX4: main mode AUTO, and its sub-modes.
AUTO, SUB_MODES = 4, {"hold": 3, "mission": 4, "return": 5, "land": 6}
# ArduCopter's modes BRAKE, which MAVSDK asks for as mode hold, AUTO, RTL and LAND.
COPTER_MODES = {"hold": 17, "mission": 3, "return": 6, "land": 9}
# The speed of a mission that has just become active, m/s, and PX4's delay until then.
DEFAULT_SPEED, ACTIVATES_S = 5.0, 0.3
# A ground station's system ID: an ArduPilot with MAV_OPTIONS obeys only this one and its own.
GROUND_STATION = 255


class PymavlinkPeer:
    """A vehicle that sends to a UDP port of loopback.

    Attributes:
        streams: the messages that it sends by default or on request. An ArduPilot's rates are 0 until
            MAV_CMD_SET_MESSAGE_INTERVAL (row 1; GCS_MAVLink_Parameters; MAVSDK-Python 637).
        obeys_requests, answers_requests: whether it obeys a request for a stream, and acknowledges it.
        received: all received messages without heartbeats, each with its time.
        silent: it sends nothing while this is set, and goes on flying and listening.
        autopilot: of its heartbeats, a MAV_AUTOPILOT.
        restarts: MIS_RESTART, with which mode AUTO begins the mission again (row 5).
        enforces_ids: of MAV_OPTIONS, whether it obeys its own system ID and a ground station's alone (row 7).
        answers_pauses: whether its answer to MAV_CMD_DO_PAUSE_CONTINUE arrives; it obeys all the same.
        pauses: whether it knows MAV_CMD_DO_PAUSE_CONTINUE, as ArduCopter does and ArduPlane and PX4 do not.
        above_home_m: height of its take-off place above its home, to which its heights refer (row 9).
    """

    def __init__(
        self, airframe: Airframe, items: list[Item], port: int, system_id: int = 1, autopilot: int = PX4
    ) -> None:
        self.airframe = airframe
        self.received: list[tuple[float, Any]] = []
        self.silent = threading.Event()
        self.autopilot = autopilot
        self.streams = set() if autopilot == ARDUPILOT else {POSITION, LANDED}
        self.obeys_requests = self.answers_requests = self.says_landed = self.answers_pauses = True
        self.restarts, self.enforces_ids, self.pauses = 0, False, autopilot == ARDUPILOT
        self.above_home_m = 0.0
        self._items = items if autopilot != ARDUPILOT else with_home(items)
        self._system_id = system_id
        # When a mission becomes active: PX4 resets the speed then, after the ACK (row 6), and stays in place before.
        self._activates_s: float | None = None
        self._link: Any = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=system_id, source_component=1
        )
        self._began = time.monotonic()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sending."""
        self._ends.set()
        self._thread.join()
        self._link.close()

    def commands(self) -> list[tuple[float, Any]]:
        """The received flight commands, each with its time."""
        flies = (SPEED, SET_MODE, PAUSE, START)
        return [(at, m) for at, m in self.received if m.get_type() == "COMMAND_LONG" and m.command in flies]

    def _live(self) -> None:
        heartbeat_at = -HEARTBEAT_S
        while not self._ends.wait(TICK_S):
            now = time.monotonic()
            if self._activates_s is not None and now >= self._activates_s:
                self._activate()
            if now - heartbeat_at >= HEARTBEAT_S and not self.silent.is_set():
                self._heartbeat()
                self._landed_state()
                heartbeat_at = now
            self._position()
            self._listen()

    def _listen(self) -> None:
        while True:
            try:
                message = self._link.recv_msg()
            except ConnectionError:
                # No socket listens on the other side.
                return
            if message is None:
                return
            if message.get_type() in ("HEARTBEAT", "BAD_DATA"):
                continue
            self.received.append((time.monotonic(), message))
            obeyed = not self.enforces_ids or message.get_srcSystem() in (self._system_id, GROUND_STATION)
            if obeyed and not self.silent.is_set():
                self._answer(message)

    def _heartbeat(self) -> None:
        mode = AUTO << 16 | SUB_MODES[self.airframe.mode] << 24
        if self.autopilot == ARDUPILOT:
            mode = COPTER_MODES[self.airframe.mode]
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.airframe.armed else 0
        self._link.mav.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR,
            self.autopilot,
            armed | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            mode,
            mavlink.MAV_STATE_ACTIVE,
        )

    def _landed_state(self) -> None:
        if LANDED in self.streams and self.says_landed:
            climbs_m, flies = self.airframe.climbs_m, mavlink.MAV_LANDED_STATE_IN_AIR
            if climbs_m is not None:
                flies = mavlink.MAV_LANDED_STATE_TAKEOFF if climbs_m > 0 else mavlink.MAV_LANDED_STATE_ON_GROUND
            self._link.mav.extended_sys_state_send(mavlink.MAV_VTOL_STATE_UNDEFINED, flies)

    def _position(self) -> None:
        latitude, longitude = self.airframe.position()
        if self.silent.is_set() or POSITION not in self.streams:
            return
        boot_ms = int((time.monotonic() - self._began) * 1000)
        height = int((self.airframe.height_m() + self.above_home_m) * 1000)
        altitude = int(GROUND_M * 1000) + height
        place = round(latitude * 1e7), round(longitude * 1e7)
        # The speed's direction does not matter here.
        north_cm_s = round(self.airframe.ground_speed * 100)
        self._link.mav.global_position_int_send(boot_ms, *place, altitude, height, north_cm_s, 0, 0, 0)

    def _answer(self, message: Any) -> None:
        sender = message.get_srcSystem(), message.get_srcComponent()
        kind = message.get_type()
        if kind == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            if message.param2 > 0 and self.obeys_requests:
                self.streams.add(int(message.param1))
            if self.answers_requests:
                self._link.mav.command_ack_send(message.command, mavlink.MAV_RESULT_ACCEPTED, 0, 0, *sender)
        elif kind == "COMMAND_LONG":
            result = self._obey(message)
            if message.command != PAUSE or self.answers_pauses:
                self._link.mav.command_ack_send(message.command, result, 0, 0, *sender)
            self._heartbeat()
        elif kind == "MISSION_REQUEST_LIST" and message.mission_type == 0:
            self._link.mav.mission_count_send(*sender, len(self._items), 0)
        elif kind == "MISSION_REQUEST_INT" and message.mission_type == 0:
            item = self._items[message.seq]
            place = round(item.latitude * 1e7), round(item.longitude * 1e7)
            first, second = item.parameters
            second = self._stored_repeats(second) if item.command == mavlink.MAV_CMD_DO_JUMP else second
            self._link.mav.mission_item_int_send(
                *sender, message.seq, 6, item.command, 0, 1, first, second, 0, float("nan"), *place, HEIGHT_M, 0
            )
        elif kind == "PARAM_REQUEST_READ" and message.param_id == "MIS_RESTART":
            self._link.mav.param_value_send(b"MIS_RESTART", self.restarts, mavlink.MAV_PARAM_TYPE_INT8, 1, 0)

    def _stored_repeats(self, repeats: float) -> float:
        """A jump's repeats as they are stored: by PX4 as uint16 of a float (row 3), by ArduPilot as int16."""
        return float(max(int(repeats), 0) % 2**16 if self.autopilot == PX4 else min(int(repeats), 2**15 - 1))

    def _obey(self, message: Any) -> int:
        """Carry out a command; returns its MAV_RESULT."""
        body = self.airframe
        body.position()
        if message.command == SPEED and not message.param2 > 0:
            return int(mavlink.MAV_RESULT_DENIED)
        if message.command == SPEED:
            # The ACK says nothing of the speed that the airframe can fly (row 2).
            body.speed = message.param2
        elif message.command == SET_MODE and self.autopilot == PX4:
            self._change_mode(next(name for name, sub in SUB_MODES.items() if sub == int(message.param3)))
        elif message.command == SET_MODE:
            self._change_mode(next(name for name, number in COPTER_MODES.items() if number == int(message.param2)))
        elif message.command == PAUSE and self.pauses:
            # ArduCopter's mode_auto.cpp pauses only on the way to a waypoint, and resumes always.
            if message.param1 == 0 and (body.mode != "mission" or body.climbs_m is not None):
                return int(mavlink.MAV_RESULT_FAILED)
            body.paused = message.param1 == 0
        elif message.command != START or self.autopilot != ARDUPILOT:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _change_mode(self, mode: str) -> None:
        body = self.airframe
        if mode != "mission" or body.mode == "mission":
            body.mode = mode
        elif self.autopilot == PX4:
            self._activates_s = time.monotonic() + ACTIVATES_S
        else:
            if self.restarts:
                body.flown_m = 0.0
            self._activate()

    def _activate(self) -> None:
        self.airframe.position()
        self.airframe.mode, self.airframe.speed, self.airframe.paused = "mission", DEFAULT_SPEED, False
        self._activates_s = None


def with_home(items: list[Item]) -> list[Item]:
    """An ArduPilot's mission on the wire: its first item is its home, and jumps name places one higher."""
    jump, home = mavlink.MAV_CMD_DO_JUMP, Item(16, 39.9, 41.4)
    later = [
        Item(i.command, 0.0, 0.0, (i.parameters[0] + 1, i.parameters[1])) if i.command == jump else i for i in items
    ]
    return [home, *later]


@contextmanager
def pymavlink_peer(
    items: list[Item], port: int, system_id: int = 1, autopilot: int = PX4, **flown: float
) -> Iterator[PymavlinkPeer]:
    """A vehicle in the air with this mission."""
    peer = PymavlinkPeer(Airframe(items, **flown), items, port, system_id, autopilot)
    try:
        yield peer
    finally:
        peer.close()
