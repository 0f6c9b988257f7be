"""`aicvds fly` against vehicles that speak MAVLink over UDP: one of MAVSDK's server plugins, one of pymavlink."""

from __future__ import annotations

import asyncio
import math
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from field.errors import VehicleError
from field.vehicles import field_run
from field.vehicles.field_run import FieldJob, run_field_mission
from field.vehicles.field_uav import LEAST_SPEED_M_S, FieldUav
from field.vehicles.mavlink_vehicle import MavlinkVehicle, mavlink_vehicle
from field.vehicles.radio import SimulatedRadio
from shared.client.edge_client import EdgeClient
from simulator.commands.replay import read_logged_mission
from simulator.records.decision import Decision
from simulator.records.mission_logs import read_decisions
from simulator.records.summary import Summary
from simulator.sites.files.world_folder import site_from_folder
from tests.conftest import Edge
from tests.support.airframe import EARTH_M, Item, without_repeats
from tests.support.edge_stub import free_port
from tests.support.flights import arguments, wait_for_reason
from tests.support.mavsdk_peer import BATTERY_PERCENT, SET_MODE, SPEED, mavsdk_peer
from tests.support.processes import output_until, run_here, started
from tests.support.pymavlink_peer import DEFAULT_SPEED, pymavlink_peer
from tests.support.waiting import PATIENCE_S, until
from tests.support.world_folders import EXAMPLE

# Beside the two commands, MAVSDK asks for telemetry's rates, for messages once, and for the autopilot's version.
HARMLESS = {SPEED, SET_MODE, 511, 512, 520}


def patient_job(port: int, edge: str, out: Path, steps: int) -> FieldJob:
    """A flight of UAV 0 that waits for the edge as long as a busy machine needs."""
    site = site_from_folder(EXAMPLE, steps)
    return FieldJob(
        site=site, radio=SimulatedRadio(site, seed=0), mavlink=(f"udpin://127.0.0.1:{port}",), first_uav=0, edge=edge,
        mission_id="m", out=out, seed=0, mode=None, deadline_ms=60_000, patience_s=PATIENCE_S, speedup=20.0,
        wait_s=PATIENCE_S,
    )  # fmt: skip


def gap_m(decision: Decision, trace: list[tuple[float, float]]) -> float:
    """The distance from a decision's position to the nearest one that the vehicle reported."""
    frame = site_from_folder(EXAMPLE).frame
    assert frame is not None
    longitude, latitude = frame.degrees([decision.position])[0].tolist()
    east = math.radians(1) * EARTH_M * math.cos(math.radians(latitude))
    north = math.radians(1) * EARTH_M
    return min(math.hypot((lat - latitude) * north, (lon - longitude) * east) for lat, lon in trace)


class Commanded:
    """The commands that the flight gives to vehicles, as they are on the wire: speeds are of single precision."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.all: list[tuple[int, float]] = []
        set_speed, hold = MavlinkVehicle.set_speed, MavlinkVehicle.hold

        async def noted_speed(vehicle: MavlinkVehicle, speed_m_s: float) -> None:
            self.all.append((SPEED, float(np.float32(speed_m_s))))
            await set_speed(vehicle, speed_m_s)

        async def noted_hold(vehicle: MavlinkVehicle) -> None:
            self.all.append((SET_MODE, 3.0))
            await hold(vehicle)

        monkeypatch.setattr(MavlinkVehicle, "set_speed", noted_speed)
        monkeypatch.setattr(MavlinkVehicle, "hold", noted_hold)


def test_a_vehicle_of_mavsdk_flies_as_the_edge_decides(
    missions: list[list[Item]], port: int, edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commanded = Commanded(monkeypatch)
    url = str(edge(mode="policy").base_url).rstrip("/")
    with mavsdk_peer(missions[0], port, speedup=20.0, start_m=300.0) as peer:
        flown = asyncio.run(run_field_mission(patient_job(port, url, tmp_path, steps=8)))
        decisions = read_decisions(tmp_path / "decisions.jsonl")
        # MAVSDK hands on a message after it has obeyed it.
        until(lambda: len(without_repeats(peer.commands())) >= len(without_repeats(commanded.all)))
        received = list(peer.received)
    assert [(d.step, d.source) for d in decisions] == [(step, "policy") for step in range(8)]
    assert decisions == flown.decisions and not flown.undecided
    assert without_repeats(peer.commands()) == without_repeats(commanded.all)
    first = decisions[0].velocity
    # One command a decision, and four corrections on the way.
    assert len(commanded.all) <= 5 * len(decisions)
    assert commanded.all[0][0] == (SPEED if first else SET_MODE)
    assert {kind for kind, _ in commanded.all} <= {SPEED, SET_MODE} and max(speed for _, speed in commanded.all) <= 14
    assert len(flown.not_carried_out) == commanded.all.count((SET_MODE, 3.0)), "MAVSDK's action server denies hold"
    commands = [fields for name, fields in received if name.startswith("COMMAND")]
    assert {fields["command"] for fields in commands} <= HARMLESS
    assert {name for name, _ in received} <= {
        "COMMAND_LONG", "PING", "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT",
        "MISSION_ACK",
    }  # fmt: skip
    assert max(gap_m(d, peer.airframe.trace) for d in decisions) < 1
    assert sum(d.collected for d in decisions) > 0
    logged = read_logged_mission(tmp_path)
    assert len(logged.decisions) == 8 and logged.spec.mode == "policy"
    with EdgeClient(url, timeout_s=PATIENCE_S) as operator:
        status = operator.mission("m")
    assert (status.decisions, status.feedback) == (8, 8)


@pytest.mark.long
def test_the_wire_by_pymavlink_positions_speeds_and_a_lost_link(
    missions: list[list[Item]], port: int, tmp_path: Path
) -> None:
    nobody = f"http://127.0.0.1:{free_port()}"
    with pymavlink_peer(missions[1], port, speedup=20.0) as peer:
        with started(*arguments(port, nobody, tmp_path, "--uav", "1", "--steps", "36")) as process:
            output_until(process, r"step 5, UAV 1")
            peer.silent.set()
            output_until(process, r"UAV 1: the link is lost")
            lost_at = time.monotonic()
            time.sleep(2.0)
            during = [at for at, _ in peer.commands() if at > lost_at + 0.1]
            before = len(peer.commands())
            peer.silent.clear()
            output_until(process, r"UAV 1: it flies its mission")
            until(lambda: len(peer.commands()) > before + 2)
            assert process.wait(60) == 0
        speeds = [message for _, message in peer.commands()]
    assert during == []
    # EOF flies at 7 m/s throughout, which the speeds make up for: ground speed, throttle as it is.
    assert {(m.command, m.param1, m.param3) for m in speeds} == {(SPEED, 1.0, -1.0)}
    assert all(LEAST_SPEED_M_S <= m.param2 <= 14.0 for m in speeds)
    assert {m.get_type() for _, m in peer.received} <= {
        "COMMAND_LONG", "PING", "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_ACK",
    }  # fmt: skip
    decisions = read_decisions(tmp_path / "decisions.jsonl")
    assert {(d.source, d.reason) for d in decisions} == {("onboard", "edge_unreachable")}
    # A decision as the link dies is made from the last position that came.
    assert max(gap_m(d, peer.airframe.trace) for d in decisions) < 1
    missing = sorted(set(range(36)) - {d.step for d in decisions})
    assert len(missing) >= 2 and missing == list(range(missing[0], missing[-1] + 1))


async def test_the_battery_is_what_the_autopilot_says(missions: list[list[Item]], port: int) -> None:
    with mavsdk_peer(missions[0], port):
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle, asyncio.timeout(PATIENCE_S):
            while (percent := (await vehicle.state()).battery_percent) is None:
                await asyncio.sleep(0.05)
            assert percent == BATTERY_PERCENT
    with pymavlink_peer(missions[0], port):
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle, asyncio.timeout(PATIENCE_S):
            while (state := await vehicle.state()).position is None:
                await asyncio.sleep(0.05)
            assert state.battery_percent is None, "it sends none"


async def test_who_flies_the_vehicle(missions: list[list[Item]], port: int) -> None:
    """A UAV holds at 0 m/s and goes on; one that a pilot holds, that left its path, or that lands gets no command."""
    with pymavlink_peer(missions[0], port, start_m=200.0) as peer:
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE))

            await wait_for_reason(uav, None)
            await uav.command(0)
            assert peer.airframe.mode == "hold"
            await uav.command(0)
            await uav.command(9)
            # PX4 forgets the speed when its mission becomes active, after both ACKs.
            until(lambda: peer.airframe.mode == "mission")
            assert peer.airframe.speed == DEFAULT_SPEED
            async with asyncio.timeout(PATIENCE_S):
                while (await vehicle.state()).mode != "mission":
                    await asyncio.sleep(0.05)
            await uav.correct(0.0, 10.0)
            assert peer.airframe.speed == pytest.approx(9.0, abs=0.5)
            commands = without_repeats(
                (m.command, m.param2 if m.command == SPEED else m.param3) for _, m in peer.commands()
            )
            assert commands[:3] == [(SET_MODE, 3.0), (SET_MODE, 4.0), (SPEED, 9.0)]
            assert [kind for kind, _ in commands[3:]] in ([], [SPEED]), (
                "the same speed again, or what is left of the way"
            )
            count = len(peer.commands())
            peer.airframe.drift_m = 150.0
            await wait_for_reason(uav, "it is off its path")
            peer.airframe.drift_m = 0.0
            await wait_for_reason(uav, None)
            peer.airframe.mode = "hold"
            await wait_for_reason(uav, "it does not fly its mission")
            peer.airframe.mode = "land"
            await wait_for_reason(uav, "it lands")
            assert uav.landed and len(peer.commands()) == count


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_the_vehicle_on_its_mission(
    missions: list[list[Item]], port: int, edge: Edge, tmp_path: Path, end: signal.Signals
) -> None:
    with (
        pymavlink_peer(missions[2], port, speedup=20.0) as peer,
        started(*arguments(port, str(edge(mode="policy").base_url), tmp_path, "--uav", "2")) as process,
    ):
        output_until(process, r"step 2, UAV 2")
        process.send_signal(end)
        assert process.wait(60) == 130
        assert peer.airframe.mode == "mission"
    logged = read_logged_mission(tmp_path).decisions
    assert len(logged) >= 3
    summary = Summary.model_validate_json((tmp_path / "summary.json").read_bytes())
    assert summary.interrupted and summary.steps_flown == summary.decisions == len(logged) < summary.steps
    assert "The mission was interrupted after step" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_mission_that_is_not_the_worlds_is_refused(missions: list[list[Item]], port: int, tmp_path: Path) -> None:
    with pymavlink_peer(missions[1], port) as peer:
        flown = run_here(*arguments(port, "http://127.0.0.1:9", tmp_path))
        assert flown.returncode == 2
        assert "waypoint 0 of its mission is" in flown.stderr and "m from that of trajectory 0" in flown.stderr
        assert "aicvds world export --plan" in flown.stderr
        assert peer.commands() == []


def test_who_does_not_fly_is_named(missions: list[list[Item]], port: int, tmp_path: Path) -> None:
    silent = run_here(*arguments(port, "http://127.0.0.1:9", tmp_path, "--wait-s", "0.3"))
    assert silent.returncode == 1 and "no autopilot was heard for 0.3 s" in silent.stderr
    with pymavlink_peer(missions[0], port) as peer:
        peer.airframe.armed = False
        flown = run_here(*arguments(port, "http://127.0.0.1:9", tmp_path, "--wait-s", "3"))
        assert flown.returncode == 1
        assert "waiting for UAV 0: it is not armed" in flown.stderr and "arm it, take off and start" in flown.stderr
        assert peer.commands() == []


def test_a_vehicle_that_does_not_take_off_leaves_no_log_in_the_way(
    missions: list[list[Item]], port: int, edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def waits_in_vain(*_: object) -> None:
        raise VehicleError("UAV 0 does not fly its mission")

    monkeypatch.setattr(field_run, "wait_for_missions", waits_in_vain)
    url = str(edge(mode="policy").base_url).rstrip("/")
    with mavsdk_peer(missions[0], port, speedup=20.0), pytest.raises(VehicleError, match="does not fly its mission"):
        asyncio.run(run_field_mission(patient_job(port, url, tmp_path, steps=2)))
    assert not (tmp_path / "decisions.jsonl").exists()
