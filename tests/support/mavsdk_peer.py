"""A MAVLink peer made of MAVSDK's server plugins: telemetry, action, mission and parameters of a vehicle."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mavsdk import Configuration, Mavsdk
from mavsdk.component_type import ComponentType
from mavsdk.logging import log_subscribe
from mavsdk.plugins import action_server, mavlink_direct_server, mission_raw_server, param_server, telemetry_server
from mavsdk.plugins.mission_raw import MissionItem, MissionRaw

from tests.support.airframe import GROUND_M, HEIGHT_M, Airframe, Item

TICK_S, BATTERY_PERCENT = 0.05, 72.0
SPEED, SET_MODE = 178, 176


class MavsdkPeer:
    """A vehicle that sends to a UDP port of loopback. MAVSDK's action server denies mode hold, whatever it receives.

    Attributes:
        received: names and fields of all received messages, without heartbeats.
        uploaded: the items of the mission that a ground station sent.
    """

    def __init__(self, airframe: Airframe, port: int, system_id: int = 1) -> None:
        log_subscribe(lambda *_: True)
        self.airframe = airframe
        self.received: list[tuple[str, dict[str, Any]]] = []
        self.uploaded: list[Any] = []
        configuration = Configuration.create_with_component_type(ComponentType.AUTOPILOT)
        configuration.system_id = system_id
        self._mavsdk = Mavsdk(configuration)
        self._mavsdk.add_any_connection(f"udpout://127.0.0.1:{port}")
        component = self._mavsdk.server_component_by_type(ComponentType.AUTOPILOT)
        self._telemetry = telemetry_server.TelemetryServer(component)
        self._action = action_server.ActionServer(component)
        self._mission = mission_raw_server.MissionRawServer(component)
        self._parameters = param_server.ParamServer(component)
        self._parameters.provide_param_int("CAL_ACC0_ID", 1)
        self._direct = mavlink_direct_server.MavlinkDirectServer(component)
        self._direct.subscribe_message("", self._take)
        self._direct.subscribe_command(SPEED, self._obey)
        self._action.subscribe_flight_mode_change(self._change_mode)
        self._mission.subscribe_incoming_mission(lambda result, plan, _: setattr(self, "uploaded", plan.mission_items))
        self._fly_on()
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._report, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sending."""
        self._ends.set()
        self._thread.join()
        self._mavsdk.destroy()

    def commands(self) -> list[tuple[int, float]]:
        """The received flight commands: number, and speed or PX4 sub-mode."""
        commands = [fields for name, fields in self.received if name in ("COMMAND_LONG", "COMMAND_INT")]
        return [
            (fields["command"], fields["param2"] if fields["command"] == SPEED else fields["param3"])
            for fields in commands
            if fields["command"] in (SPEED, SET_MODE)
        ]

    def _fly_on(self) -> None:
        modes = action_server.AllowableFlightModes()
        modes.can_auto_mode = modes.can_auto_loiter_mode = modes.can_auto_land_mode = True
        self._action.set_allowable_flight_modes(modes)
        self._action.set_armable(True, True)
        self._action.set_armed_state(True)
        self._action.set_flight_mode_internal(action_server.FlightMode.MISSION)

    def _report(self) -> None:
        still = telemetry_server.VelocityNed(0.0, 0.0, 0.0)
        while not self._ends.wait(TICK_S):
            latitude, longitude = self.airframe.position()
            position = telemetry_server.Position(latitude, longitude, GROUND_M + HEIGHT_M, HEIGHT_M)
            # The server plugin wants a share.
            self._telemetry.publish_battery(telemetry_server.Battery(16.0, BATTERY_PERCENT / 100))
            self._telemetry.publish_position(position, still, telemetry_server.Heading(0.0))

    def _change_mode(self, result: Any, mode: Any, _: object) -> None:
        if result == action_server.ActionServerResult.SUCCESS:
            self._action.set_flight_mode_internal(mode)

    def _take(self, message: Any, _: object) -> None:
        if message.message_name != "HEARTBEAT":
            self.received.append((message.message_name, json.loads(message.fields_json)))

    def _obey(self, message: Any, _: object) -> None:
        fields = json.loads(message.fields_json)
        self.airframe.position()
        self.airframe.speed = fields["param2"]
        answer = {"command": fields["command"], "result": 0, "progress": 0, "result_param2": 0}
        target = {"target_system": message.system_id, "target_component": message.component_id}
        self._direct.send_message(
            mavlink_direct_server.MavlinkMessage(
                "COMMAND_ACK", 1, 1, message.system_id, message.component_id, json.dumps(answer | target)
            )
        )


@contextmanager
def mavsdk_peer(items: list[Item], port: int, system_id: int = 1, **flown: float) -> Iterator[MavsdkPeer]:
    """A vehicle in the air, whose mission a ground station uploads to it."""
    peer = MavsdkPeer(Airframe(items, **flown), port, system_id)
    try:
        upload(items, port)
        yield peer
    finally:
        peer.close()


def upload(items: list[Item], port: int) -> None:
    """Upload a mission as a ground station does, and hang up."""
    with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as ground:
        ground.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = ground.first_autopilot(30.0)
        assert system is not None, "the ground station hears no vehicle"
        sent = [
            MissionItem(
                seq=number, frame=6, command=item.command, current=int(number == 0), autocontinue=1,
                param1=item.parameters[0], param2=item.parameters[1], param3=0.0, param4=float("nan"),
                x=round(item.latitude * 1e7), y=round(item.longitude * 1e7), z=HEIGHT_M, mission_type=0,
            )
            for number, item in enumerate(items)
        ]  # fmt: skip
        MissionRaw(system).upload_mission(sent)
