"""The speed of the simulated world: a batch of worlds in numpy, and single worlds, on one core.

    python -m benchmarks.world --worlds 1024

It prints world steps a second (one step of one world counts as one) of both, their ratio, and the time to draw a world,
for `paper` and for `field`, which differs from an edge's model in everything: links by place, bursts of arrivals, wind,
dead radios, a UAV that leaves. It writes the same as JSON. The actions are random. Seconds are the process's own on its
core, not the clock's, and the best of several rounds counts, because other work on the machine can only slow a round.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Goal, Options, Report, run
from lab.marl.training_worlds import drawn
from shared.world.scenario import Scenario, scenario_named
from simulator.world.batch import Draw, VectorWorld
from simulator.world.environment import PipelineWorld

# World steps a second of a batch and of a single world.
GOALS = {"paper": (300_000, 5_000), "field": (20_000, None)}


@dataclass(frozen=True)
class World(Options):
    """Step a batch of worlds and single worlds, and compare."""

    worlds: int = 1024
    """Worlds in the batch, B."""
    scenarios: tuple[str, ...] = tuple(GOALS)
    """Scenarios of the worlds."""
    rounds: int = 5
    """Missions of the batch, and ten times as many single missions; the fastest counts."""


def measure(args: World) -> Report:
    """Step batches, then single worlds."""
    found = {name: _measured(name, args) for name in args.scenarios}
    goals = [
        Goal(f"world steps a second, {kind}, {name}", found[name][f"{kind}_steps_per_s"], least=least)
        for name in args.scenarios
        for kind, least in zip(("batch", "single"), GOALS.get(name, (None, None)), strict=True)
        if least is not None
    ]
    columns = {quantity: {name: row[quantity] for name, row in found.items()} for quantity in found[args.scenarios[0]]}
    return Report({"worlds": args.worlds, "scenarios": found}, {"One core": columns}, goals)


def _measured(name: str, args: World) -> dict[str, float]:
    """The figures of one scenario."""
    scenario = scenario_named(name)
    rng = np.random.default_rng(0)
    shape = (scenario.steps, args.worlds, scenario.uavs)
    sensors = rng.integers(scenario.sensors, size=shape)
    velocities = rng.integers(scenario.max_velocity + 1, size=shape)
    began = time.process_time()
    draw = drawn(scenario, range(args.worlds))
    draw_us = (time.process_time() - began) / args.worlds * 1e6
    batch_s = min(_batch(scenario, draw, sensors, velocities) for _ in range(args.rounds))
    single_s = min(_single(scenario, n, sensors[:, 0], velocities[:, 0]) for n in range(10 * args.rounds))
    return {
        "batch_steps_per_s": round(scenario.steps * args.worlds / batch_s),
        "single_steps_per_s": round(scenario.steps / single_s),
        "ratio": round(args.worlds * single_s / batch_s, 1),
        "draw_us_per_world": round(draw_us, 1),
        "batch_step_ms": round(batch_s / scenario.steps * 1e3, 3),
    }


def _batch(scenario: Scenario, draw: Draw, sensors: NDArray[np.int64], velocities: NDArray[np.int64]) -> float:
    """Seconds of one mission of every world."""
    world = VectorWorld(scenario)
    world.start(draw)
    return _timed(lambda: [world.fly(*pair) for pair in zip(sensors, velocities, strict=True)])


def _single(scenario: Scenario, seed: int, sensors: NDArray[np.int64], velocities: NDArray[np.int64]) -> float:
    """Seconds of one mission of one world."""
    world = PipelineWorld(scenario)
    world.reset(seed=seed)
    actions = [dict(zip(world.agents, pairs, strict=True)) for pairs in np.stack((sensors, velocities), axis=-1)]
    # A UAV may leave before the end.
    return _timed(lambda: [world.step({agent: action[agent] for agent in world.agents}) for action in actions])


def _timed(run: Callable[[], object]) -> float:
    began = time.process_time()
    run()
    return time.process_time() - began


if __name__ == "__main__":
    run(World, measure)
