"""The flight of real UAVs, against a real edge; vehicles, clock and sensors are simulated."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from field.errors import VehicleError
from field.vehicles.field_flight import FieldFlight, RealFlight
from field.vehicles.field_pilot import FieldPilot
from field.vehicles.field_uav import FieldUav
from field.vehicles.radio import Beacon, Collected, Radio, SimulatedRadio, Spot, radio_named
from shared.client.edge_client import AsyncEdgeClient, EdgeClient
from shared.wire.schemas import DecideRequest
from shared.world.trajectory import trajectories
from simulator.errors import UsageError
from simulator.records.decision import Decision
from simulator.records.real_uavs import sums_by_uav
from simulator.sites.fence import Fence
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.site import Site
from tests.conftest import Edge
from tests.support.edge_stub import free_port
from tests.support.places import ROOT
from tests.support.stub_vehicle import SimulatedClock, StubVehicle
from tests.support.waiting import PATIENCE_S
from tests.support.world_folders import EXAMPLE

STEPS = 12
# Of the first UAV's path, metres.
START = (149.195, 2000.464)


class Trial:
    """Three stub vehicles over the example's sensors."""

    def __init__(self, wind: float = 1.0, steps: int = STEPS) -> None:
        self.site: Site = site_from_folder(EXAMPLE, steps)
        self.clock = SimulatedClock()
        self.vehicles = [StubVehicle(self.site, uav, self.clock, wind) for uav in range(3)]
        self.uavs = [FieldUav(uav, vehicle, self.site) for uav, vehicle in enumerate(self.vehicles)]
        self.radio: Radio = SimulatedRadio(self.site, seed=0)
        self.events: list[tuple[int, str]] = []
        self.requests: list[DecideRequest] = []
        self.last_error: str | None = None

    async def fly(self, url: str, on_decision: object = None, attempts: int = 2) -> RealFlight:
        def decided(decision: Decision) -> None:
            if callable(on_decision):
                on_decision(decision)

        async with AsyncEdgeClient(url, timeout_s=PATIENCE_S, attempts=attempts) as client:
            pilot = FieldPilot(client, "field", self.site.scenario, PATIENCE_S)
            pilot.on_request = self.requests.append
            flight = FieldFlight(
                self.site, self.uavs, self.radio, pilot, self.clock, decided, lambda uav, text: self.tell(uav, text)
            )
            flown = await flight.fly()
            self.last_error = pilot.last_error
            return flown

    def tell(self, uav: int, text: str) -> None:
        self.events.append((uav, text))


def nobody() -> str:
    return f"http://127.0.0.1:{free_port()}"


async def test_the_edge_decides_every_waypoint_and_hears_every_outcome(edge: Edge) -> None:
    trial, url = Trial(), str(edge(mode="policy").base_url)
    flown = await trial.fly(url)
    assert [(d.step, d.uav_id, d.source) for d in flown.decisions] == [
        (step, uav, "policy") for step in range(STEPS) for uav in range(3)
    ]
    with EdgeClient(url) as operator:
        status = operator.mission("field")
    assert (status.decisions, status.feedback) == (3 * STEPS, 3 * STEPS)
    assert sum(d.collected for d in flown.decisions) > 0 and flown.late == 0 and not flown.undecided
    assert flown.mode == "policy" and flown.steps_flown == STEPS
    assert isinstance(trial.radio, SimulatedRadio)
    assert sum(t.lost_packets for t in flown.tally) <= trial.radio.lost
    for uav, vehicle in enumerate(trial.vehicles):
        own = [d for d in flown.decisions if d.uav_id == uav]
        assert [command for command in vehicle.commands if isinstance(command, float)] == [
            d.velocity for d in own if d.velocity
        ]
        assert vehicle.mode == "mission"
        for decision in own:
            assert trajectories(trial.site.scenario)[uav].locate(decision.position)[1] < 0.1


@pytest.mark.parametrize(
    ("velocity", "commanded", "flown_m"),
    [
        # Of 10 s to the next waypoint 2 s are over at the last speed, 10 m/s.
        (6, 5.0, 60.0),
        (10, 10.0, 100.0),
        # As fast as it may, and too late all the same.
        (14, 14.0, 132.0),
        # It has flown farther than decided.
        (1, "hold", 20.0),
        (0, "hold", 20.0),
    ],
)
async def test_the_speed_makes_up_for_the_time_of_the_decision(
    velocity: int, commanded: float | str, flown_m: float
) -> None:
    trial = Trial()
    uav, vehicle, clock = trial.uavs[0], trial.vehicles[0], trial.clock
    await uav.update(10.0)
    await uav.command(10)
    await clock.until(10.0)
    await uav.update(10.0)
    assert vehicle.flown_m == pytest.approx(100.0)
    await clock.until(12.0)
    await uav.command(velocity, decided_s=2.0)
    await clock.until(20.0)
    await vehicle.state()
    assert vehicle.commands[-1] == commanded
    assert vehicle.flown_m == pytest.approx(100.0 + flown_m)


async def test_a_uav_that_waited_during_the_decision_flies_faster_after_it() -> None:
    trial = Trial()
    uav, vehicle, clock = trial.uavs[0], trial.vehicles[0], trial.clock
    await uav.update(10.0)
    await uav.command(0)
    await clock.until(12.0)
    await uav.command(8, decided_s=2.0)
    await clock.until(20.0)
    await vehicle.state()
    assert vehicle.commands == ["hold", "resume", 10.0]
    assert vehicle.flown_m == pytest.approx(80.0)


async def test_the_speed_of_a_late_decision_is_the_decided_one() -> None:
    trial = Trial()
    uav, vehicle = trial.uavs[0], trial.vehicles[0]
    await uav.update(10.0)
    await trial.clock.until(10.0)
    await uav.command(9, decided_s=10.0)
    await uav.correct(2.0, 8.0)
    assert vehicle.commands == [9.0]


async def test_the_progress_flown_counts_not_the_speed_commanded() -> None:
    """An airframe that flies half of every commanded speed is corrected until it is where it should be."""
    trial = Trial(wind=0.5)
    uav, vehicle, clock = trial.uavs[0], trial.vehicles[0], trial.clock
    await uav.update(10.0)
    await uav.command(6)
    for now_s in (2.0, 4.0, 6.0, 8.0):
        await clock.until(now_s)
        await uav.correct(2.0, 10.0 - now_s)
    await clock.until(10.0)
    await uav.update(2.0)
    assert vehicle.commands == [6.0, 6.75, 7.88, 9.84, 14.0]
    assert uav.flown_m == pytest.approx(6.0 + 6.75 + 7.88 + 9.84 + 14.0, abs=0.1)


async def test_reports_have_the_battery_where_the_autopilot_says_it_and_the_height(edge: Edge) -> None:
    trial = Trial(steps=2)
    trial.vehicles[1].battery_percent = 61.5
    await trial.fly(str(edge(mode="policy").base_url))
    assert {r.uav_id: r.battery_percent for r in trial.requests} == {0: None, 1: 61.5, 2: None}
    assert {r.height_m for r in trial.requests} == {100.0}


async def test_the_edge_decides_no_velocity_that_an_airframe_was_seen_not_to_reach(edge: Edge) -> None:
    trial, url = Trial(), str(edge(mode="policy").base_url)
    for vehicle in trial.vehicles[:2]:
        vehicle.top = 8.97
    flown = await trial.fly(url)
    limited = [d for d in flown.decisions if d.uav_id < 2]
    assert max(d.velocity for d in limited if d.step == 0) > 9 and {d.source for d in limited} == {"policy"}
    seen = {r.uav_id: r.step for r in reversed(trial.requests) if r.top_speed_mps is not None}
    assert seen[0] <= 2 and seen[1] <= 2 and 2 not in seen
    assert all(r.top_speed_mps in (None, 8.97) for r in trial.requests)
    assert max(d.velocity for d in limited if d.step >= 2) == 9
    assert max(d.velocity for d in flown.decisions if d.uav_id == 2 and d.step >= 2) > 9
    path = trajectories(trial.site.scenario)[0]
    reports = {r.step: r.progress_m or 0.0 for r in trial.requests if r.uav_id == 0}
    for d in limited:
        if d.uav_id == 0 and 2 <= d.step < STEPS - 1:
            flown_m = math.remainder(reports[d.step + 1] - reports[d.step], path.length_m)
            assert flown_m == pytest.approx(10.0 * d.velocity, rel=0.05, abs=1.0)


class Counting:
    """Sensors 0 and 1 with scripted counters of lost packets, by step; UAV 1 hears sensor 1 alone."""

    def __init__(self, counters: Sequence[tuple[int, int]]) -> None:
        self.counters = counters

    async def beacons(self, spot: Spot) -> dict[int, Beacon]:
        counted = enumerate(self.counters[spot.step])
        return {j: Beacon(30, 40.0, -90.0, lost) for j, lost in counted if spot.uav == 0 or j == 1}

    async def collect(self, spot: Spot, sensor: int) -> Collected:
        return Collected(5, failed=spot.uav == 1)


async def test_what_a_sensor_lost_counts_once_and_from_its_first_beacon_on() -> None:
    trial = Trial(steps=4)
    trial.uavs = trial.uavs[:2]
    # In the third step sensor 1 starts again: its counter falls, and no loss is negative.
    trial.radio = Counting([(100, 7), (103, 9), (103, 9), (103, 0), (103, 4)])
    flown = await trial.fly(nobody(), attempts=1)
    assert [(t.lost_packets, t.overflows, t.failures) for t in flown.tally] == [
        (5, 2, 1),
        (0, 0, 1),
        (0, 0, 1),
        (4, 1, 1),
    ]
    assert [d.lost_packets for d in flown.decisions] == [5, 2, 0, 0, 0, 0, 4, 4]
    assert all(int(t.collected.sum()) == 10 for t in flown.tally)
    assert [(u.uav_id, u.decisions, u.collected, u.failures, u.lost_packets) for u in sums_by_uav(flown.decisions)] == [
        (0, 4, 20, 0, 9),
        (1, 4, 20, 4, 6),
    ]


async def test_an_edge_that_forgot_the_mission_decides_on(edge: Edge) -> None:
    trial, url = Trial(), str(edge(mode="policy").base_url)
    with EdgeClient(url, timeout_s=PATIENCE_S) as operator:

        def forget(decision: Decision) -> None:
            if (decision.step, decision.uav_id) == (4, 2):
                operator.delete_mission("field")

        flown = await trial.fly(url, forget)
        status = operator.mission("field")
    assert {(d.source, d.reason) for d in flown.decisions} == {("policy", "mode_policy")}, trial.last_error
    assert status.scenario == trial.site.scenario
    assert status.decisions == status.feedback == 3 * (STEPS - 5)


async def test_without_an_edge_they_decide_on_board_and_no_two_alike() -> None:
    trial = Trial()
    flown = await trial.fly(nobody(), attempts=1)
    assert {(d.source, d.reason) for d in flown.decisions} == {("onboard", "edge_unreachable")}
    assert len(flown.decisions) == len(trial.requests) == 3 * STEPS
    for step in range(STEPS):
        assert len({d.sensor_id for d in flown.decisions if d.step == step}) == 3


async def test_the_progress_and_the_metres_of_the_report_are_the_true_ones() -> None:
    trial = Trial(wind=0.5)
    flown = await trial.fly(nobody(), attempts=1)
    assert len(flown.decisions) == 3 * STEPS
    for request in trial.requests:
        path = trajectories(trial.site.scenario)[request.uav_id]
        assert request.progress_m is not None
        assert path.at(request.progress_m) == pytest.approx(request.position, abs=1.0)
    for uav, vehicle in enumerate(trial.vehicles):
        decided_m, flown_m = flown.metres[uav]
        # EOF flies at 7 m/s, which takes all of the 14 m/s that it may be commanded.
        assert decided_m == 70.0 * STEPS and flown_m == pytest.approx(vehicle.flown_m, abs=1.0)
        assert flown_m < 0.95 * decided_m


async def test_a_uav_that_lands_gets_no_more_commands_and_the_others_fly_on() -> None:
    trial = Trial()
    trial.vehicles[1].lands_at_s = 35.0
    flown = await trial.fly(nobody(), attempts=1)
    assert [d.step for d in flown.decisions if d.uav_id == 1] == [0, 1, 2, 3]
    assert flown.undecided == {"it lands": STEPS - 4} and (1, "it lands") in trial.events
    assert len([d for d in flown.decisions if d.uav_id != 1]) == 2 * STEPS


async def test_a_uav_that_flies_on_after_landing_is_commanded_to_the_end() -> None:
    trial = Trial()
    trial.vehicles[1].lands_at_s, trial.vehicles[1].flies_on_at_s = 35.0, 45.0
    trial.vehicles[2].lands_at_s, trial.vehicles[2].flies_on_at_s = 55.0, 65.0
    trial.vehicles[0].lands_at_s = 75.0
    flown = await trial.fly(nobody(), attempts=1)
    assert flown.steps_flown == STEPS and flown.ended == {0: "it lands"}
    assert [d.step for d in flown.decisions if d.uav_id == 1] == [0, 1, 2, 3, *range(5, STEPS)]


async def test_a_uav_off_its_path_gets_no_command() -> None:
    trial = Trial()
    trial.vehicles[0].shift_m = 150.0
    flown = await trial.fly(nobody(), attempts=1)
    assert trial.vehicles[0].commands == [] and flown.undecided == {"it is off its path": STEPS}
    assert {d.uav_id for d in flown.decisions} == {1, 2}


# Both circles are around where the first UAV begins; it flies on its path throughout.
@pytest.mark.parametrize("fence", [Fence("no_fly", (START,), 1000.0), Fence("fence", (START,), 25.0)])
async def test_a_uav_outside_the_fence_gets_no_command(fence: Fence) -> None:
    trial = Trial()
    trial.uavs[0] = FieldUav(0, trial.vehicles[0], replace(trial.site, fences=(fence,)))
    flown = await trial.fly(nobody(), attempts=1)
    inside = int(fence.role == "fence")
    assert flown.undecided == {"it is outside the fence": STEPS - inside}
    assert len(trial.vehicles[0].commands) == inside and len(flown.decisions) == 2 * STEPS + inside


async def test_the_simulated_sensors_are_those_of_simulate() -> None:
    """With every sensor in range of one UAV that collects, packets, queues and losses go as in the simulated world."""
    site = site_from_folder(EXAMPLE, STEPS)
    world, radio = site.world(), SimulatedRadio(site, seed=3)
    observations, _ = world.reset(seed=3)
    for step in range(STEPS):
        here = world.fleet.positions
        heard = [await radio.beacons(Spot(uav, step, tuple(here[uav]), (0.0, 0.0))) for uav in range(3)]
        for uav in range(3):
            seen = observations[f"uav_{uav}"]
            now = [j for j in range(site.scenario.sensors) if seen["last_heard"][j] == step]
            assert sorted(heard[uav]) == now
            for j in now:
                beacon = heard[uav][j]
                assert beacon.queue == seen["queue"][j]
                assert beacon.battery_j == pytest.approx(seen["battery"][j])
                assert beacon.channel_gain_db == pytest.approx(seen["channel_gain"][j])
        chosen = [step % site.scenario.sensors, (step + 5) % site.scenario.sensors, step % site.scenario.sensors]
        actions = {f"uav_{uav}": [chosen[uav], 14] for uav in range(3)}
        observations, _, _, _, infos = world.step(actions)
        for uav in range(3):
            x, y = world.fleet.positions[uav].tolist()
            got = await radio.collect(Spot(uav, step, (x, y), (0.0, 0.0)), chosen[uav])
            assert (got.packets, got.failed) == (infos[f"uav_{uav}"]["collected"], infos[f"uav_{uav}"]["failed"])
    await radio.beacons(Spot(0, STEPS, (0.0, 0.0), (0.0, 0.0)))
    assert radio.lost == world.sensors.lost.sum()


async def test_a_pilot_who_takes_a_waiting_uav_over_keeps_it() -> None:
    trial = Trial()
    uav, vehicle = trial.uavs[0], trial.vehicles[0]
    await uav.update(0.0)
    await uav.command(0)
    vehicle.mode = "other"
    await uav.update(10.0)
    assert uav.unavailable_reason == "it does not fly its mission"
    await uav.resume_mission()
    assert vehicle.commands == ["hold"]
    vehicle.mode = "mission"
    await uav.update(10.0)
    assert uav.unavailable_reason is None
    vehicle.mode = "other"
    with pytest.raises(VehicleError, match="stub 0 got no command to fly at 0 m/s: it does not fly its mission"):
        await uav.command(0)
    assert vehicle.commands == ["hold"]


async def test_a_command_that_is_not_carried_out_is_reported() -> None:
    trial = Trial()
    trial.vehicles[2].deaf = True
    flown = await trial.fly(nobody(), attempts=1)
    assert len(flown.not_carried_out) == STEPS and (2, "stub 2 did not do 7.0: TIMEOUT") in trial.events
    assert len(flown.decisions) == 3 * STEPS


async def test_a_mission_of_another_world_is_not_joined(edge: Edge) -> None:
    url, site = str(edge(mode="policy").base_url), site_from_folder(EXAMPLE, STEPS)
    async with AsyncEdgeClient(url, timeout_s=PATIENCE_S) as client:
        assert (await FieldPilot(client, "m", site.scenario, PATIENCE_S).join()).scenario == site.scenario
        assert (await FieldPilot(client, "m", site.scenario, PATIENCE_S).join()).decisions == 0
        other = site_from_folder(EXAMPLE, STEPS + 1).scenario
        with pytest.raises(UsageError, match="--mission m: the edge has this mission for another world"):
            await FieldPilot(client, "m", other, PATIENCE_S).join()
        with pytest.raises(UsageError, match="in mode policy; leave out --mode"):
            await FieldPilot(client, "m", site.scenario, PATIENCE_S, mode="llm").join()


PAGE = ROOT / "docs" / "guides" / "uav.md"


async def test_the_radio_shown_in_the_docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [shown] = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "own_gateway.py").write_text(shown, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    site = site_from_folder(EXAMPLE)
    radio = radio_named("own_gateway:Gateway", site, seed=0)
    spot = Spot(0, 0, (0.0, 0.0), (0.0, 0.0))
    assert await radio.beacons(spot) == {0: Beacon(12, 41.5, -93.0, 3)}
    assert await radio.collect(spot, 0) == Collected(12, failed=False)
    for name, why in (
        ("own_gateway", "write simulated, or MODULE:NAME"),
        ("no_such:Radio", "No module named 'no_such'; it is looked for in the working directory"),
        ("own_gateway:Radio", "has no attribute 'Radio'"),
    ):
        with pytest.raises(UsageError, match=why):
            radio_named(name, site, seed=0)
