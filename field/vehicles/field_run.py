"""One command's flight of real UAVs: connect, check, wait for the missions, fly, write the log."""

import asyncio
import math
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TypeVar

from field.errors import VehicleError
from field.vehicles.field_flight import FieldFlight, MissionClock, RealFlight
from field.vehicles.field_pilot import FieldPilot
from field.vehicles.field_uav import FieldUav
from field.vehicles.mavlink_vehicle import mavlink_vehicle
from field.vehicles.radio import Radio
from shared.client.edge_client import API_KEY, AsyncEdgeClient
from shared.client.errors import EdgeError
from shared.wire.schemas import Mode
from simulator.commands.running import leave_terminal
from simulator.errors import UsageError
from simulator.records.decision import Decision
from simulator.records.mission_logs import DecisionLog, RequestLog, with_edge_defaults
from simulator.records.run_folder import DECISIONS, REQUESTS, fresh_folder, naming_out
from simulator.sites.plans.mission_path import DELAY, JUMP, WAYPOINT, MissionItem, path_of, repeats_forever
from simulator.sites.site import Site

T = TypeVar("T")


@dataclass(frozen=True)
class FieldJob:
    """A flight of real UAVs.

    ``mavlink`` has the connections of UAVs ``first_uav`` and the ones after it. ``seed`` is the simulated sensors';
    ``None`` for real ones.
    """

    site: Site
    radio: Radio
    mavlink: Sequence[str]
    first_uav: int
    edge: str
    mission_id: str
    out: Path
    seed: int | None
    mode: Mode | None
    deadline_ms: int
    patience_s: float
    speedup: float
    wait_s: float
    system_id: int | None = None


class FlightInterrupted(Exception):
    """The flight was ended by a signal; ``flight`` is the part flown, ``None`` before the first waypoint."""

    def __init__(self, flight: RealFlight | None) -> None:
        super().__init__()
        self.flight = flight


async def run_field_mission(job: FieldJob) -> RealFlight:
    """Connect to the vehicles, wait until they fly their missions, fly, and write the log as it happens.

    SIGINT, SIGTERM and SIGHUP end the flight after the present commands; vehicles that wait are sent on.

    Raises:
        UsageError: a connection, a vehicle's mission or the folder is unusable.
        VehicleError: a vehicle is not heard, or does not fly its mission.
        FlightInterrupted: a signal ended the flight.
    """
    flight: FieldFlight | None = None
    try:
        with cancel_on_signals():
            async with AsyncExitStack() as stack:
                warnings: list[str] = []
                uavs = [
                    await stack.enter_async_context(connect_uav(job, number, warnings))
                    for number in range(len(job.mavlink))
                ]
                client = await stack.enter_async_context(edge_client(job))
                pilot = FieldPilot(client, job.mission_id, job.site.scenario, job.patience_s, job.mode, job.deadline_ms)
                pilot.spec = job.site.named(pilot.spec)
                await join_mission(pilot, job)
                await wait_for_missions(uavs, job.wait_s, lambda uav, why: print_line(f"waiting for UAV {uav}: {why}"))
                logs = stack.enter_context(open_logs(job, pilot))
                flight = FieldFlight(
                    job.site, uavs, job.radio, pilot, MissionClock(job.speedup),
                    flown_on(lambda decision: log_decision(decision, logs)),
                    lambda uav, text: print_line(f"UAV {uav}: {text}"),
                )  # fmt: skip
                flight.result.warnings = warnings
                flown = await flight.fly()
                if pilot.last_error is not None:
                    print_line(f"the edge's last failure: {pilot.last_error}")
                return flown
    except asyncio.CancelledError:
        if flight is not None:
            flight.result.interrupted = True
        raise FlightInterrupted(None if flight is None else flight.result) from None


@asynccontextmanager
async def connect_uav(job: FieldJob, number: int, warnings: list[str]) -> AsyncIterator[FieldUav]:
    """The UAV at one of the job's connections, its mission checked; what may go wrong with it is appended."""
    index = job.first_uav + number
    async with mavlink_vehicle(job.mavlink[number], job.wait_s, job.system_id) as vehicle:
        items = await vehicle.mission()
        height_m = check_uploaded(items, job.site, index, vehicle.name)
        for text in doubts_of(items, job.site):
            warnings.append(f"UAV {index}: {text}")
            print_line(f"warning: {warnings[-1]}")
        yield FieldUav(index, vehicle, job.site, height_m)


def edge_client(job: FieldJob) -> AsyncEdgeClient:
    """A client that gives up before the UAVs do."""
    return AsyncEdgeClient(job.edge, timeout_s=job.patience_s, attempts=2, api_key=os.environ.get(API_KEY) or None)


async def join_mission(pilot: FieldPilot, job: FieldJob) -> None:
    """Make or find the mission at the edge; without an edge the UAVs begin on board."""
    try:
        status = await pilot.join()
        pilot.spec = with_edge_defaults(pilot.spec, status)
        print_line(f"mission {job.mission_id}, mode {status.mode}; watch it at {job.edge}/?mission={job.mission_id}")
        if status.decisions:
            print_line(
                f"it has {status.decisions} decisions already: if they are of an earlier flight, DELETE it first"
            )
    except EdgeError as error:
        print_line(f"{error}; the UAVs decide on board until it answers")


@contextmanager
def open_logs(job: FieldJob, pilot: FieldPilot) -> Iterator[DecisionLog]:
    """The log of decisions; requests are logged as they are sent."""
    fresh_folder(job.out)
    with ExitStack() as stack:
        with naming_out(job.out):
            requests = stack.enter_context(RequestLog(job.out / REQUESTS, pilot.spec))
            decisions = stack.enter_context(DecisionLog(job.out / DECISIONS))
        pilot.on_request = flown_on(requests.append)
        yield decisions


def flown_on(log: Callable[[T], None]) -> Callable[[T], None]:
    """The same log, but a full disk costs its lines, not the flight."""

    def write(entry: T) -> None:
        try:
            log(entry)
        except OSError as error:
            print_line(f"the log lacks a line: {error}")

    return write


def log_decision(decision: Decision, log: DecisionLog) -> None:
    """Write and show a decision."""
    log.append(decision)
    d = decision
    by = d.source if d.reason is None else f"{d.source}, {d.reason}"
    print_line(
        f"step {d.step}, UAV {d.uav_id}: sensor {d.sensor_id} at {d.velocity} m/s ({by}), "
        f"{'failed' if d.failed else f'{d.collected} packets'}, cost {d.cost:.2f}"
    )


def print_line(text: str) -> None:
    """Print a line of the flight to stderr, at once."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def cancel_on_signals() -> Iterator[None]:
    """Within the context SIGINT, SIGTERM and SIGHUP, unless ignored, cancel the present task."""
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None, "a coroutine runs in a task"

    def cancel(number: int) -> None:
        leave_terminal(number)
        task.cancel()

    numbers = [n for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) != signal.SIG_IGN]
    for number in numbers:
        loop.add_signal_handler(number, cancel, number)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)


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


# MAVLink sends positions to the centimetre, and a plan may have been drawn on a map again. Heights change the links
# less.
TOLERANCE_M, HEIGHT_TOLERANCE_M = 2.0, 5.0


def doubts_of(items: Sequence[MissionItem], site: Site) -> list[str]:
    """What of a vehicle's mission the world does not have: other heights, times to wait, and an end."""
    doubts, world = [], site.scenario
    heights = [item.altitude_m for item in items if item.command == WAYPOINT]
    known = [height for height in heights if height is not None]
    if len(known) < len(heights):
        doubts.append(
            f"{len(heights) - len(known)} waypoints' heights are not above the take-off place, and cannot be compared "
            f"with the world's {world.altitude_m:g} m"
        )
    elif any(abs(height - world.altitude_m) > HEIGHT_TOLERANCE_M for height in known):
        doubts.append(
            f"its waypoints are {min(known):g} to {max(known):g} m above the take-off place, the world's UAVs fly at "
            f"{world.altitude_m:g} m: the edge expects other links"
        )
    waits_s = sum(item.parameters[0] for item in items if item.command in (WAYPOINT, DELAY) and item.parameters[0] > 0)
    if any(item.command == DELAY and item.parameters[0] < 0 for item in items):
        doubts.append("it waits until a time of day, which no decision counts on")
    if stops := [item.number for item in items if not item.autocontinue]:
        doubts.append(f"autocontinue is off at items {stops}: the autopilot may stop there")
    if waits_s:
        doubts.append(f"it waits {waits_s:g} s at its waypoints, which no decision counts on")
    jump = next((item for item in items if item.command == JUMP), None)
    if jump is None or not repeats_forever(jump):
        repeats = "once" if jump is None else f"{jump.parameters[1] + 1:g} times"
        doubts.append(f"it flies its path {repeats}, and ends then, whatever number of steps is left")
    return doubts


def check_uploaded(items: Sequence[MissionItem], site: Site, uav: int, vehicle: str) -> float:
    """Compare a vehicle's mission with the trajectory of a UAV.

    Returns:
        The height of the lowest waypoint above the take-off place, m; infinite where none has one above that.

    Raises:
        UsageError: the mission is no path of straight legs, or another path; the text names the waypoint.
    """
    assert site.frame is not None, "a site with vehicles has a place on the globe"
    remedy = "upload the plan that `aicvds world export --plan` writes, or take this one over by `aicvds world import`"
    try:
        path = path_of(items)
    except ValueError as error:
        raise UsageError(f"{vehicle}: its mission cannot be flown: {error}") from None
    flown = [(x, y) for x, y in site.frame.metres(site.frame.bent(path.trajectory)).tolist()]
    # As :func:`path_of` has them: without repeated waypoints, and a way back that is drawn out is not flown twice.
    route = [point for point, _ in groupby(site.scenario.routes[uav])]
    route = route[: len(route) // 2 + 1] if len(route) > 2 and route == route[::-1] else route
    for index, (here, there) in enumerate(zip(flown, route, strict=False)):
        gap = math.dist(here, there)
        if not gap <= TOLERANCE_M:
            raise UsageError(
                f"{vehicle}: waypoint {index} of its mission is {gap:,.0f} m from that of trajectory {uav} in the "
                f"world; {remedy}"
            )
    if len(flown) != len(route):
        raise UsageError(
            f"{vehicle}: its mission's path has {len(flown)} waypoints, trajectory {uav} of the world has "
            f"{len(route)}; {remedy}"
        )
    # Within the tolerance it may still break what the trajectory keeps.
    if any(fence.first_breach(flown) is not None for fence in site.fences):
        raise UsageError(f"{vehicle}: its mission leaves the world's fence, or enters a no_fly area; {remedy}")
    return min((height for height in path.altitudes_m if height is not None), default=math.inf)
