"""The flights of the claims map: every scheme at every point, kept in a file each, so that a stopped run continues."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from lab.claims_map.deciders import EdgeDecider, EdgeFleet
from lab.claims_map.points import Point
from lab.experiments.execution import commit
from shared.world.channel import IntArray
from shared.world.scenario import Scenario
from simulator.policies.registry import policy_named
from simulator.world.environment import PipelineWorld

# The paper's view: its five features, and each UAV's own reports.
_VIEW = {"features": "paper", "belief": "reported"}
KEPT = (3, 5, 7)
STARTS = {"shipped": "pretrained", "random": "random"}
FORMULAS = ("eof", "wqcs")
LEARNED = ("madqn_paper", "mappo", "madqn")


def chooser_name(start: str, k: int) -> str:
    """The name of look-ahead behind attention that keeps ``k`` sensors."""
    return f"look_ahead_{start}_k{k}"


EVERY_SENSOR = "look_ahead_all"
AT_THE_EDGE: dict[str, EdgeDecider] = {
    "value": EdgeDecider("value", {}),
    **{
        chooser_name(start, k): EdgeDecider("look_ahead", {**_VIEW, "init": init, "top_k": k})
        for start, init in STARTS.items()
        for k in KEPT
    },
    EVERY_SENSOR: EdgeDecider("look_ahead", {**_VIEW, "attention": "off"}),
}
SCHEMES = (*FORMULAS, *LEARNED, *AT_THE_EDGE)


@dataclass(frozen=True, eq=False)
class Flown:
    """One scheme's missions in S worlds of T steps: whole numbers.

    Attributes:
        lost: packets lost in each step, ``(S, T)``.
        failed: failed transmissions in each step, ``(S, T)``.
        overflows: sensors that overflowed in each step, ``(S, T)``.
        visits: successful transmissions of each sensor, ``(S, J)``.
        seconds: duration of the missions, ``()``.
        commit: of the code that flew them; empty outside a repository.
    """

    lost: IntArray
    failed: IntArray
    overflows: IntArray
    visits: IntArray
    seconds: float
    commit: str

    def save(self, path: Path) -> None:
        """Write to a compressed file, atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, **vars(self))
        part.replace(path)

    @classmethod
    def load(cls, path: Path) -> Flown:
        """Read such a file; raises ``OSError`` or ``ValueError``."""
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("lost", "failed", "overflows", "visits")}
            return cls(**arrays, seconds=float(file["seconds"]), commit=str(file["commit"]))


def fly(scheme: str, scenario: Scenario, seeds: Sequence[int]) -> Flown:
    """One scheme's missions in these worlds."""
    began = time.perf_counter()
    if scheme in LEARNED:
        lost, failed, overflows, visits = _fly_learned(scheme, scenario, seeds)
    else:
        worlds = [_fly_one(scheme, scenario, seed) for seed in seeds]
        lost, failed, overflows, visits = (np.array(part) for part in zip(*worlds, strict=True))
    return Flown(lost, failed, overflows, visits, time.perf_counter() - began, commit() or "")


def _fly_one(scheme: str, scenario: Scenario, seed: int) -> tuple[list[int], list[int], list[int], IntArray]:
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=seed)
    edge = EdgeFleet(AT_THE_EDGE[scheme], scenario, seed) if scheme in AT_THE_EDGE else None
    if edge is None:
        policy = policy_named(scheme)
        policy.reset(scenario, seed)
    visits = np.zeros(scenario.sensors, dtype=np.int64)
    while world.agents:
        live, actions, taken = dict(world.live), dict[str, tuple[int, int]](), frozenset[int]()
        for agent, uav in live.items():
            if edge is None:
                actions[agent] = policy.decide(uav, observations[agent], taken)
            else:
                actions[agent] = edge.decide(uav, observations[agent])
            taken |= {actions[agent][0]}
        observations, _, _, _, infos = world.step(actions)
        for agent, uav in live.items():
            failed = bool(infos[agent]["failed"])
            visits[actions[agent][0]] += not failed
            if edge is not None:
                edge.take(uav, float(infos[agent]["cost"]), failed)
    tally = world.tally
    return [t.lost_packets for t in tally], [t.failures for t in tally], [t.overflows for t in tally], visits


def _fly_learned(scheme: str, scenario: Scenario, seeds: Sequence[int]) -> tuple[IntArray, ...]:
    """As ``lab.marl.evaluate.lost_packets``, all worlds at once, with the shipped weights."""
    from lab.marl.checkpoint import shipped
    from lab.marl.evaluate import flown_greedily

    steps = list(flown_greedily(scenario, shipped(scheme).network(scenario), seeds))
    visits = np.zeros((len(seeds), scenario.sensors), dtype=np.int64)
    for chosen, outcome in steps:
        for uav in range(scenario.uavs):
            np.add.at(visits, (np.arange(len(seeds)), chosen[:, uav]), 1 - outcome.failed[:, uav])
    lost, overflows = (np.stack([getattr(o, n) for _, o in steps], axis=1) for n in ("lost_packets", "overflows"))
    return lost, np.stack([o.failed.sum(axis=1) for _, o in steps], axis=1), overflows, visits


def flights_file(folder: Path, point: Point, scheme: str, seeds: int) -> Path:
    """The file of a scheme's flights at a point in the worlds 0 to ``seeds`` - 1."""
    return folder / f"{point.name}-{scheme}-{seeds}.npz"


def fly_all(points: Sequence[Point], seeds: int, folder: Path, console: Console) -> Iterator[Point]:
    """Fly the missing flights, point by point; yields each point once its flights are complete."""
    for number, point in enumerate(points, 1):
        began, flew = time.perf_counter(), 0
        for scheme in SCHEMES:
            path = flights_file(folder, point, scheme, seeds)
            if not path.exists():
                fly(scheme, point.scenario, range(seeds)).save(path)
                flew += 1
        took = f", {time.perf_counter() - began:.0f} s" if flew else ", flown before"
        console.print(f"{number} of {len(points)}: {point.row}, {point.rate:g} a step{took}", highlight=False)
        yield point
