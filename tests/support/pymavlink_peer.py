"""A MAVLink peer made with pymavlink alone: an implementation of the protocol that shares nothing with MAVSDK."""

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
PX4, ARDUPILOT = mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
# PX4: main mode AUTO, and its sub-modes.
AUTO, SUB_MODES = 4, {"hold": 3, "mission": 4, "land": 6}
# ArduCopter's modes LOITER, AUTO and LAND.
COPTER_MODES = {"hold": 5, "mission": 3, "land": 9}


class PymavlinkPeer:
    """A vehicle that sends to a UDP port of loopback, and answers as a PX4 does.

    As an ArduPilot it sends no position until MAV_CMD_SET_MESSAGE_INTERVAL asks for it, whose stream rates are 0 at
    first (GCS_MAVLink_Parameters; MAVSDK-Python 637).

    Attributes:
        streams: whether it sends positions.
        obeys_requests, answers_requests: whether it obeys a request for a stream, and acknowledges it.
        received: all messages that came, without heartbeats, with the time.
        silent: it sends nothing while this is set, and goes on flying and listening.
        autopilot: of its heartbeats, a MAV_AUTOPILOT.
    """

    def __init__(
        self, airframe: Airframe, items: list[Item], port: int, system_id: int = 1, autopilot: int = PX4
    ) -> None:
        self.airframe = airframe
        self.received: list[tuple[float, Any]] = []
        self.silent = threading.Event()
        self.autopilot = autopilot
        self.streams = autopilot != ARDUPILOT
        self.obeys_requests = self.answers_requests = True
        self._items = items
        self._link: Any = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=system_id, source_component=1
        )
        self._began = time.monotonic()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Fall silent."""
        self._ends.set()
        self._thread.join()
        self._link.close()

    def commands(self) -> list[tuple[float, Any]]:
        """The commands that fly it, with the time."""
        return [(at, m) for at, m in self.received if m.get_type() == "COMMAND_LONG" and m.command in (SPEED, SET_MODE)]

    def _live(self) -> None:
        heartbeat_at = -HEARTBEAT_S
        while not self._ends.wait(TICK_S):
            now = time.monotonic()
            if now - heartbeat_at >= HEARTBEAT_S and not self.silent.is_set():
                self._heartbeat()
                heartbeat_at = now
            self._position()
            self._listen()

    def _listen(self) -> None:
        while True:
            try:
                message = self._link.recv_msg()
            except ConnectionError:
                # Nobody listens on the other side.
                return
            if message is None:
                return
            if message.get_type() in ("HEARTBEAT", "BAD_DATA"):
                continue
            self.received.append((time.monotonic(), message))
            if not self.silent.is_set():
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

    def _position(self) -> None:
        latitude, longitude = self.airframe.position()
        if self.silent.is_set() or not self.streams:
            return
        boot_ms = int((time.monotonic() - self._began) * 1000)
        height = int(self.airframe.height_m() * 1000)
        altitude = int(GROUND_M * 1000) + height
        place = round(latitude * 1e7), round(longitude * 1e7)
        self._link.mav.global_position_int_send(boot_ms, *place, altitude, height, 0, 0, 0, 0)

    def _answer(self, message: Any) -> None:
        sender = message.get_srcSystem(), message.get_srcComponent()
        kind = message.get_type()
        if kind == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            if message.param1 == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT and message.param2 > 0:
                self.streams = self.streams or self.obeys_requests
            if self.answers_requests:
                self._link.mav.command_ack_send(message.command, mavlink.MAV_RESULT_ACCEPTED, 0, 0, *sender)
        elif kind == "COMMAND_LONG":
            self._link.mav.command_ack_send(message.command, self._obey(message), 0, 0, *sender)
            self._heartbeat()
        elif kind == "MISSION_REQUEST_LIST" and message.mission_type == 0:
            self._link.mav.mission_count_send(*sender, len(self._items), 0)
        elif kind == "MISSION_REQUEST_INT" and message.mission_type == 0:
            item = self._items[message.seq]
            place = round(item.latitude * 1e7), round(item.longitude * 1e7)
            self._link.mav.mission_item_int_send(
                *sender, message.seq, 6, item.command, 0, 1, *item.parameters, 0, float("nan"), *place, HEIGHT_M, 0
            )

    def _obey(self, message: Any) -> int:
        """Carry out a command; returns its MAV_RESULT."""
        if message.command == SPEED:
            self.airframe.position()
            self.airframe.speed = message.param2
        elif message.command == SET_MODE:
            self.airframe.position()
            self.airframe.mode = next(name for name, sub in SUB_MODES.items() if sub == int(message.param3))
        else:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        return int(mavlink.MAV_RESULT_ACCEPTED)


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
