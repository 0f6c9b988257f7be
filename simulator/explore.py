"""``aicvds explore``: fly training worlds with exploring UAVs and record every decision, for ``aicvds pretrain``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from tyro.conf import arg

from shared.rollouts import Header, RolloutStep, write_rollouts
from shared.scenario import Scenario, scenario_named

# Training worlds start here, so that no evaluation seed (from 0) is ever among them.
FIRST_TRAINING_SEED = 1_000_000
_BEHAVIOUR = "half EOF or WQCS, half a random sensor heard; a random velocity"


@dataclass(frozen=True)
class Explore:
    """Fly training worlds with exploring UAVs and record what they saw, did and paid.

    Half of the decisions are EOF's or WQCS's, half a random sensor; velocities are random. The worlds' seeds start
    at 1,000,000, apart from every evaluation seed. The file feeds `aicvds pretrain`.
    """

    out: Annotated[Path, arg(metavar="FILE")]
    """File to write, such as runs/rollouts.jsonl.gz."""
    missions: Annotated[int, arg(metavar="N")] = 600
    """Worlds to fly."""
    scenario: Annotated[str, arg(metavar="NAME")] = "paper"
    """Their scenario."""


def main(argv: list[str]) -> int:
    """Record the rollouts that the command line describes; returns the exit code."""
    args = tyro.cli(Explore, prog="aicvds explore", args=argv)
    try:
        scenario = scenario_named(args.scenario)
        if args.missions < 1:
            raise ValueError(f"--missions {args.missions} is not at least 1")
        args.out.parent.mkdir(parents=True, exist_ok=True)
        header = Header(scenario=scenario, missions=args.missions, behaviour=_BEHAVIOUR)
        seeds = track(range(args.missions), description="Exploring", console=Console())
        write_rollouts(args.out, header, (step for seed in seeds for step in explore(scenario, seed)))
    except (ValueError, OSError) as error:
        print(f"aicvds explore: {error}", file=sys.stderr)
        return 2
    print(f"Wrote {args.out}")
    return 0


def explore(scenario: Scenario, mission: int) -> Iterator[RolloutStep]:
    """One mission's decisions in order of step and UAV, in training world number ``mission``."""
    from simulator.mission import decide_request
    from simulator.policies import policy_named
    from simulator.world import PipelineWorld

    rng = np.random.default_rng([FIRST_TRAINING_SEED, mission])
    guides = [policy_named("eof"), policy_named("wqcs")]
    for guide in guides:
        guide.reset(scenario, mission)
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=FIRST_TRAINING_SEED + mission)
    for _ in range(scenario.steps):
        choices: list[tuple[int, int]] = []
        for uav in range(scenario.uavs):
            observation = observations[f"uav_{uav}"]
            taken = frozenset(sensor for sensor, _ in choices)
            sensor, _ = guides[rng.integers(2)].decide(uav, observation, taken)
            heard = np.flatnonzero(observation["last_heard"] >= 0)
            if rng.random() < 0.5 and len(heard):
                sensor = int(rng.choice(heard))
            choices.append((sensor, int(rng.integers(scenario.max_velocity + 1))))
        requests = [decide_request(uav, observations[f"uav_{uav}"], f"train-{mission}") for uav in range(scenario.uavs)]
        observations, _, _, _, infos = world.step({f"uav_{u}": np.array(c) for u, c in enumerate(choices)})
        for uav, (sensor, velocity) in enumerate(choices):
            info = infos[f"uav_{uav}"]
            yield RolloutStep(
                request=requests[uav],
                sensor_id=sensor,
                velocity=velocity,
                cost=float(info["cost"]),
                failed=bool(info["failed"]),
                fleet_lost=world.tally[-1].lost_packets,
            )
