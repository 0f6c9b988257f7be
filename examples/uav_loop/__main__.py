"""Fly the stub vehicle against an edge: ``python -m examples.uav_loop --edge http://localhost:8000``."""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import tyro

from examples.uav_loop.loop import Flown, Leg, Loop
from examples.uav_loop.stub import StubWorld
from examples.uav_loop.vehicle import LocalFrame
from shared.scenario import Scenario
from shared.trajectory import trajectories
from simulator.client import AsyncEdgeClient
from simulator.errors import EdgeError

# Seconds that a UAV waits for its edge before take-off; then it flies on board.
GROUND_S = 20.0
# The south-west corner of the area, WGS 84.
ORIGIN = (39.9312, 41.2345)
SITES = (
    (180.0, 160.0), (430.0, 330.0), (690.0, 190.0), (860.0, 420.0),
    (640.0, 560.0), (820.0, 830.0), (420.0, 700.0), (170.0, 560.0),
)  # fmt: skip
ROUTE = ((250.0, 250.0), (750.0, 250.0), (750.0, 750.0), (250.0, 750.0), (250.0, 250.0))


@dataclass(frozen=True)
class Job:
    """Fly one stub UAV over eight sensors, in simulated time. Prints one line a step, and the sums at the end."""

    edge: str = "http://localhost:8000"
    """The edge's URL; a key goes into AICVDS_API_KEY."""
    steps: int = 30
    """Decisions to ask for, one every ten simulated seconds."""
    seed: int = 0
    """The seed of the sensors' queues and arrivals."""


def world(steps: int) -> Scenario:
    """One UAV on a square, eight surveyed sensors."""
    return Scenario(
        name="uav_loop", uavs=1, sensors=len(SITES), steps=steps, layout="surveyed", sites=SITES, routes=(ROUTE,),
        pipeline=(),
    )  # fmt: skip


async def flown(job: Job) -> Flown:
    """The mission, from making it at the edge to the last outcome."""
    scenario, frame = world(job.steps), LocalFrame(*ORIGIN)
    x, y = trajectories(scenario)[0].at(0.0).tolist()
    stub = StubWorld(scenario, frame, (x, y), job.seed)
    mission_id = f"uav_loop-{job.seed}-{secrets.token_hex(4)}"
    async with AsyncEdgeClient(job.edge, attempts=2, api_key=os.environ.get("AICVDS_API_KEY") or None) as edge:
        try:
            await edge.wait_ready(GROUND_S, on_wait=_say_once(f"waiting {GROUND_S:g} s for the edge at {job.edge}"))
        except EdgeError as error:
            print(f"{error}; flying on board. `aicvds serve` starts an edge.", file=sys.stderr)
        return await Loop(stub.vehicle(), edge, scenario, frame, mission_id, on_leg=_tell).fly()


def _tell(leg: Leg) -> None:
    print(
        f"step {leg.step}: sensor {leg.sensor} at {leg.velocity} m/s ({leg.decided_by}), "
        f"{leg.packets} packets, cost {leg.cost:.2f}",
        file=sys.stderr,
    )


def _say_once(what: str) -> Callable[[str], None]:
    """Prints what is waited for, with the first cause."""
    said: list[str] = []

    def waiting(cause: str) -> None:
        if not said:
            said.append(cause)
            print(f"{what}: {cause}", file=sys.stderr, flush=True)

    return waiting


def main() -> None:
    """Fly, and print the sums as JSON; Ctrl-C ends it."""
    job = tyro.cli(Job, description=Job.__doc__)
    try:
        result = asyncio.run(flown(job))
    except EdgeError as error:
        sys.exit(f"uav_loop: {error}")
    except KeyboardInterrupt:
        print("uav_loop: interrupted", file=sys.stderr)
        sys.exit(130)
    sums = {
        "steps": len(result.legs),
        "decided_by": Counter(leg.decided_by for leg in result.legs),
        "packets": sum(leg.packets for leg in result.legs),
        "cost": round(sum(leg.cost for leg in result.legs), 3),
        "outcomes_told": result.outcomes_told,
        "went_home": result.went_home,
        "last_error": result.last_error,
    }
    print(json.dumps(sums, indent=2))


if __name__ == "__main__":
    main()
