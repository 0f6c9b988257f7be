"""The losses over links with the statistics of measured ones: mode `policy`, heuristics, the learned radio map.

    python -m lab.benchmarks.gain_traces --seeds 30

Each seed draws the gain traces of all UAVs and sensors, like those of measured flights: an excess loss over the mean
path loss that is, for each sensor, a Gaussian process over the UAVs' places, with a correlation of 0.93 at 5 m, 0.49 at
50 m and 0.06 at 200 m and a standard deviation of 8 to 16 dB, another for each sensor. `--scales` multiplies them all.
No recorded trace is used, as none has a licence.

It flies scenario `paper` over these links with mode `policy` over HTTP, with the planner on board, with and without
learning, and with four heuristics at 7 and 14 m/s. It prints each scheme's lost packets and their ratio to the best
heuristic's (goal of mode `policy`: 0.6). Then it flies two laps and more, and compares the excess loss 50 m ahead on
the second lap with the radio map's prediction and with the formula's, which is 0 dB (goal: an error at least 40%
smaller). It writes the same as JSON. One seed takes some fifteen seconds.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from lab.experiments.edges import Llm, edge_for
from lab.experiments.formula_planner import FormulaPlanner
from lab.experiments.intervals import interval, paired
from lab.experiments.schemes import OFF
from shared.client.edge_client import EdgeClient
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario, scenario_named
from shared.world.step_rule import Action
from shared.world.trajectory import trajectories
from simulator.flying.flight import fly, rollout
from simulator.flying.pilots import EdgePilot
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.policies.registry import Policy, policy_named
from simulator.sites.site import Site
from simulator.world.gain_trace import GainTrace
from simulator.world.observation import Observation

GOAL, GOAL_AHEAD = 0.6, 0.4
# The traces: between two points, the distance over which the correlation falls to 1/e, and the standard deviations.
SPACING_M, CORRELATION_M, LEAST_DB, MOST_DB = 5.0, 70.0, 8.0, 16.0
HEURISTICS = ("longest_queue", "queue_and_channel", "max_gain", "nearest")
AHEAD_M = 50.0
# Two laps at 7 m/s.
LAPS_STEPS = 54


@dataclass(frozen=True)
class Traced:
    """Fly worlds whose links have the statistics of measured ones."""

    seeds: int = 30
    """Worlds: seeds --first to --first + N - 1."""
    first: int = 0
    """The first seed."""
    scales: tuple[float, ...] = (0.4, 0.7, 1.0)
    """Factors of the traces' excess losses."""
    out: Path = Path("runs/gain_traces.json")
    """Where to write the figures."""


def drawn_trace(scenario: Scenario, seed: int, scale: float) -> GainTrace:
    """The gain trace of a world; the same seed gives the same trace at every scale."""
    rng, paths = np.random.default_rng([seed, 50]), trajectories(scenario)
    ways = [np.arange(0.0, path.length_m, SPACING_M) for path in paths]
    places = np.concatenate([path.at(way) for path, way in zip(paths, ways, strict=True)])
    apart = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
    shape = np.linalg.cholesky(np.exp(-apart / CORRELATION_M) + 1e-6 * np.eye(len(places)))
    ends = np.cumsum([len(way) for way in ways])[:-1]
    points: dict[tuple[int, int], tuple[FloatArray, FloatArray]] = {}
    for sensor in range(scenario.sensors):
        deviation = scale * rng.uniform(LEAST_DB, MOST_DB)
        excess = np.split(deviation * (shape @ rng.standard_normal(len(places))), ends)
        points |= {(uav, sensor): (ways[uav], excess[uav]) for uav in range(len(paths))}
    return GainTrace(points)


class AtFullSpeed:
    """A heuristic at the highest velocity.

    Args:
        name: of the policy.
    """

    def __init__(self, name: str) -> None:
        self._policy = policy_named(name)

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission."""
        self._velocity = scenario.max_velocity
        self._policy.reset(scenario, seed)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """The heuristic's sensor."""
        return self._policy.decide(uav, observation, taken)[0], self._velocity


class Laps(RecedingHorizonPolicy):
    """Laps at a steady velocity, while the belief learns; it notes the map's errors ahead on the second lap.

    Attributes:
        errors: the map's prediction less the true excess loss, dB, and the true one, for each sensor in radio range of
            a place ``AHEAD_M`` ahead.
    """

    def __init__(self, site: Site, velocity: int) -> None:
        self._site, self._velocity = site, velocity
        self._paths = trajectories(site.scenario)
        self._start: dict[int, float] = {}
        self.errors: list[tuple[float, float]] = []

    def _plan_action(self, uav: int, taken: frozenset[int]) -> Action:
        last, path = self.belief.uavs[uav], self._paths[uav]
        assert last.progress_m is not None
        first = self._start.setdefault(uav, last.progress_m)
        if last.progress_m - first >= path.length_m:
            self._compare(uav, last.progress_m + AHEAD_M)
        # In turn, so that no two UAVs name the same one.
        sensor = (last.step * len(self._paths) + uav) % self._site.scenario.sensors
        return Action(sensor, self._velocity)

    def _compare(self, uav: int, progress_m: float) -> None:
        place = self._paths[uav].at(progress_m)
        near = np.hypot(*(self.belief.places - place).T) <= self._site.scenario.radio_radius_m
        assert self._site.gains is not None
        every = np.full(len(self._paths), progress_m)
        true = self._site.gains.excess_db(every, self._paths, len(near))[uav, near]
        mean, _ = self.belief.channel.radio_map.predict(place[None], np.flatnonzero(near))
        self.errors += zip((mean[0] - true).tolist(), true.tolist(), strict=True)


def heuristics() -> Iterator[tuple[str, Policy]]:
    """The heuristics at 7 and 14 m/s."""
    for name in HEURISTICS:
        yield name, policy_named(name)
        yield f"{name}_fast", AtFullSpeed(name)


def flown(url: str, site: Site, seed: int, scale: float) -> dict[str, int]:
    """Packets lost in one world, by scheme."""
    # A second flight with the same mission name would look like repeated requests to the edge.
    mission_id = f"trace-{scale:g}-{seed}"
    with EdgeClient(url, timeout_s=60.0) as client:
        pilot = EdgePilot(client, mission_id, site.scenario, seed)
        pilot.spec = pilot.spec.model_copy(update={"mode": "policy"})
        client.put_mission(mission_id, pilot.spec)
        policy = fly(site, pilot, seed).tally
    on_board = {"mpc": policy_named("mpc"), "mpc_formula": FormulaPlanner(), **dict(heuristics())}
    tallies = {name: rollout(site.world(), scheme, seed) for name, scheme in on_board.items()}
    return {name: sum(step.lost_packets for step in tally) for name, tally in {"policy": policy, **tallies}.items()}


def smaller_error(site: Site, seed: int, velocity: int) -> tuple[float, float]:
    """Root mean square errors 50 m ahead on the second lap, dB: the map's and the formula's."""
    laps = Laps(site, velocity)
    rollout(site.world(), laps, seed)
    by_map, by_formula = np.sqrt(np.mean(np.square(laps.errors), axis=0)).tolist()
    return by_map, by_formula


def main(args: Traced) -> int:
    """Fly, print, write."""
    console, seeds = Console(), range(args.first, args.first + args.seeds)
    scenario = scenario_named("paper")
    found = []
    with (
        tempfile.TemporaryDirectory() as folder,
        edge_for(OFF, Llm("none"), Path(folder) / "edge.log", console) as edge,
    ):
        for scale in args.scales:
            sites = [replace(Site(scenario), gains=drawn_trace(scenario, seed, scale)) for seed in seeds]
            worlds = track(zip(sites, seeds, strict=True), f"Links x {scale}", total=len(seeds), console=console)
            lost = [flown(edge.url, site, seed, scale) for site, seed in worlds]
            found.append({"scale": scale, **_losses(console, lost), "ahead": _ahead(console, sites, list(seeds))})
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"seeds": list(seeds), "goals": [GOAL, GOAL_AHEAD], "worlds": found}, indent=2))
    console.print(f"Wrote {args.out}")
    return 0


def _losses(console: Console, lost: list[dict[str, int]]) -> dict[str, object]:
    by_scheme = {name: [world[name] for world in lost] for name in lost[0]}
    means = {name: interval(packets) for name, packets in by_scheme.items()}
    best = min((name for name, _ in heuristics()), key=lambda name: means[name].mean)
    compared = [
        pair for name in by_scheme for pair in paired(name, best, "lost_packets", by_scheme[name], by_scheme[best])
    ]
    ratios = {pair.scheme: pair for pair in compared if pair.kind == "ratio"}
    for name, mean in means.items():
        ratio = ratios[name]
        console.print(
            f"{name}: {mean.mean:.1f} [{mean.low:.1f}, {mean.high:.1f}] lost, "
            f"{ratio.mean:.2f} [{ratio.low:.2f}, {ratio.high:.2f}] times {best}"
        )
    return {"lost_packets": by_scheme, "best": best, "compared": [pair.model_dump() for pair in compared]}


def _ahead(console: Console, sites: list[Site], seeds: list[int]) -> dict[str, list[tuple[float, float]]]:
    found = {}
    for velocity in (7, 14):
        errors = []
        for site, seed in zip(sites, seeds, strict=True):
            long = site.scenario.model_copy(update={"steps": LAPS_STEPS})
            errors.append(smaller_error(replace(site, scenario=long), seed, velocity))
        by_map, by_formula = np.mean(errors, axis=0)
        share = interval([1.0 - learned / formula for learned, formula in errors])
        console.print(
            f"{AHEAD_M:.0f} m ahead on the second lap at {velocity} m/s: map {by_map:.1f} dB, formula {by_formula:.1f} "
            f"dB, smaller by {share.mean:.2f} [{share.low:.2f}, {share.high:.2f}]"
        )
        found[str(velocity)] = errors
    return found


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Traced, description=__doc__)))
