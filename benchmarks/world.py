"""The speed of the world: a batch of worlds in numpy beside single worlds, on one core.

    python benchmarks/world.py --worlds 1024

It prints world steps a second (one step of one world counts as one) of both, their ratio, and the time to draw a world;
it writes the same as JSON. The actions are random. Seconds are the process's own on its core, not the clock's, and the
best of several rounds counts, because other work on the machine can only slow a round.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from shared.world.scenario import Scenario, scenario_named
from simulator.world.batch import Draw, VectorWorld
from simulator.world.environment import PipelineWorld

GOAL_BATCH, GOAL_SINGLE = 300_000, 5_000


@dataclass(frozen=True)
class World:
    """Step a batch of worlds and single worlds, and compare."""

    worlds: int = 1024
    """Worlds in the batch, B."""
    scenario: str = "paper"
    """Scenario of the worlds."""
    rounds: int = 5
    """Missions of the batch, and ten times as many single missions; the fastest counts."""
    out: Path = Path("runs/world.json")
    """Where to write."""


def main(args: World) -> int:
    """Measure, print, write."""
    scenario = scenario_named(args.scenario)
    rng = np.random.default_rng(0)
    shape = (scenario.steps, args.worlds, scenario.uavs)
    sensors = rng.integers(scenario.sensors, size=shape)
    velocities = rng.integers(scenario.max_velocity + 1, size=shape)
    began = time.process_time()
    draw = Draw.of(scenario, range(args.worlds))
    draw_us = (time.process_time() - began) / args.worlds * 1e6
    batch_s = min(_batch(scenario, draw, sensors, velocities) for _ in range(args.rounds))
    single_s = min(_single(scenario, n, sensors[:, 0], velocities[:, 0]) for n in range(10 * args.rounds))
    found = {
        "scenario": args.scenario,
        "worlds": args.worlds,
        "command": sys.argv,
        "batch_steps_per_s": round(scenario.steps * args.worlds / batch_s),
        "single_steps_per_s": round(scenario.steps / single_s),
        "ratio": round(args.worlds * single_s / batch_s, 1),
        "draw_us_per_world": round(draw_us, 1),
        "batch_step_ms": round(batch_s / scenario.steps * 1e3, 3),
        "goal_batch": GOAL_BATCH,
        "goal_single": GOAL_SINGLE,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    Console().print(_table(found))
    return 0


def _batch(scenario: Scenario, draw: Draw, sensors: NDArray[np.int64], velocities: NDArray[np.int64]) -> float:
    """Seconds of one mission of every world."""
    world = VectorWorld(scenario)
    world.start(draw)
    return _timed(lambda: [world.step(*pair) for pair in zip(sensors, velocities, strict=True)])


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


def _table(found: dict[str, object]) -> Table:
    table = Table("", "world steps / s", "goal", title=f"{found['scenario']}, B = {found['worlds']}, one core")
    table.add_row("batch", f"{found['batch_steps_per_s']:,}", f"{GOAL_BATCH:,}")
    table.add_row("single", f"{found['single_steps_per_s']:,}", f"{GOAL_SINGLE:,}")
    table.add_row("batch / single", f"{found['ratio']}", "")
    table.add_row("drawing a world", f"{found['draw_us_per_world']} us", "")
    return table


if __name__ == "__main__":
    sys.exit(main(tyro.cli(World)))
