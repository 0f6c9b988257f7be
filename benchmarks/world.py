"""The speed of the world: a batch of worlds in numpy beside single worlds, on one core.

    python -m benchmarks.world --worlds 1024

It prints world steps a second (one step of one world counts as one) of both, their ratio, and the time to draw a world;
it writes the same as JSON. The actions are random. Seconds are the process's own on its core, not the clock's, and the
best of several rounds counts, because other work on the machine can only slow a round.
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

GOAL_BATCH, GOAL_SINGLE = 300_000, 5_000


@dataclass(frozen=True)
class World(Options):
    """Step a batch of worlds and single worlds, and compare."""

    worlds: int = 1024
    """Worlds in the batch, B."""
    scenario: str = "paper"
    """Scenario of the worlds."""
    rounds: int = 5
    """Missions of the batch, and ten times as many single missions; the fastest counts."""


def measure(args: World) -> Report:
    """Step the batch, then single worlds."""
    scenario = scenario_named(args.scenario)
    rng = np.random.default_rng(0)
    shape = (scenario.steps, args.worlds, scenario.uavs)
    sensors = rng.integers(scenario.sensors, size=shape)
    velocities = rng.integers(scenario.max_velocity + 1, size=shape)
    began = time.process_time()
    draw = drawn(scenario, range(args.worlds))
    draw_us = (time.process_time() - began) / args.worlds * 1e6
    batch_s = min(_batch(scenario, draw, sensors, velocities) for _ in range(args.rounds))
    single_s = min(_single(scenario, n, sensors[:, 0], velocities[:, 0]) for n in range(10 * args.rounds))
    batch, single = round(scenario.steps * args.worlds / batch_s), round(scenario.steps / single_s)
    found: dict[str, str | float] = {
        "scenario": args.scenario,
        "worlds": args.worlds,
        "batch_steps_per_s": batch,
        "single_steps_per_s": single,
        "ratio": round(args.worlds * single_s / batch_s, 1),
        "draw_us_per_world": round(draw_us, 1),
        "batch_step_ms": round(batch_s / scenario.steps * 1e3, 3),
    }
    goals = [
        Goal("world steps a second, batch", batch, least=GOAL_BATCH),
        Goal("world steps a second, single", single, least=GOAL_SINGLE),
    ]
    return Report(found, {"One core": {name: {"measured": value} for name, value in found.items()}}, goals)


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
    return _timed(lambda: [world.step(action) for action in actions])


def _timed(run: Callable[[], object]) -> float:
    began = time.process_time()
    run()
    return time.process_time() - began


if __name__ == "__main__":
    run(World, measure)
