"""The numbers of the paper's figures: losses by step, tokens by step, round trips by place."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from lab.claims_map.deciders import EdgeFleet
from lab.claims_map.flights import AT_THE_EDGE, chooser_name
from lab.experiments.edges import Llm, edge_for
from lab.experiments.schemes import ADAPTED, OFF
from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.prompting.prompt import Prompt
from service.prompting.token_accounting import TokenCounter
from shared.client.edge_client import EdgeClient
from shared.world.channel import FloatArray
from shared.world.scenario import Point, Scenario
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Observation

_DEADLINE_MS = 60_000


def tokens_by_step(scenario: Scenario, seeds: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Tokens of the state block a query, with attention (k = 5) and with every sensor, ``(S, T, I)`` each.

    The prompt is the paper's, the decider is look-ahead in the LLM's place.
    """
    counter, scheme = TokenCounter(Settings(store="none").cache_dir), AT_THE_EDGE[chooser_name("shipped", 5)]
    counts = np.zeros((2, len(seeds), scenario.steps, scenario.uavs))
    for place, seed in enumerate(seeds):
        world = PipelineWorld(scenario)
        observations, _ = world.reset(seed=seed)
        fleet = EdgeFleet(scheme, scenario, seed)
        while world.agents:
            live, step = dict(world.live), len(world.tally)
            actions = {}
            for agent, uav in live.items():
                actions[agent] = fleet.decide(uav, observations[agent])
                found = counter.account(_prompt(fleet.state))
                counts[:, place, step, uav] = found.state, found.state_uncompressed
            observations, _, _, _, infos = world.step(actions)
            for agent, uav in live.items():
                fleet.take(uav, float(infos[agent]["cost"]), bool(infos[agent]["failed"]))
    return counts[0], counts[1]


def _prompt(state: AttendedState) -> Prompt:
    mission = state.mission
    return mission.template.prompt(state.state, state.shown(), mission.experiences.block)


@dataclass(frozen=True, eq=False)
class Trips:
    """The round trips of one UAV's queries in one mission: its places ``(T, 2)``, m, and the times ``(T,)``, ms."""

    uav: int
    places: FloatArray
    milliseconds: FloatArray


def round_trips(scenario: Scenario, seeds: Sequence[int], llm: bool, console: Console) -> list[Trips]:
    """The round trips of missions over an edge: in mode ``llm`` with the shipped adapter, or in mode ``value``."""
    found = []
    with (
        tempfile.TemporaryDirectory() as folder,
        edge_for(ADAPTED if llm else OFF, Llm(), Path(folder) / "edge.log", console) as edge,
        EdgeClient(edge.url, timeout_s=_DEADLINE_MS / 1e3 + 5) as client,
    ):
        for seed in seeds:
            pilot = _TimedPilot(client, f"trips-{seed}", scenario, seed, deadline_ms=_DEADLINE_MS)
            mode = {"mode": "llm" if llm else "value", "verify": "off", "planner": "off"}
            pilot.spec = pilot.spec.model_validate({**pilot.spec.model_dump(), **mode})
            client.put_mission(f"trips-{seed}", pilot.spec)
            fly(Site(scenario), pilot, seed)
            for uav, trips in sorted(pilot.trips.items()):
                rows = np.array(trips)
                found.append(Trips(uav, rows[:, :2], rows[:, 2]))
    return found


class _TimedPilot(EdgePilot):
    """Records in ``trips`` the place and round trip of every answered query, by UAV."""

    trips: dict[int, list[tuple[float, float, float]]]

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The edge's choice."""
        choice = super().decide(uav, observation, taken)
        if choice.exchange is not None:
            x, y = observation["position"].tolist()
            self.trips = getattr(self, "trips", {})
            self.trips.setdefault(uav, []).append((x, y, choice.exchange.rtt_ms))
        return choice


def spatial_share(trips: Sequence[Trips], centres: Sequence[Point], shifts: int = 2000) -> tuple[float, float]:
    """The share of the round trips' variance that the place explains, and the probability of as much by chance.

    The place is the phase on the UAV's circle, as two harmonics of its own for each UAV; the times are logarithms less
    their mission's mean. Chance is the same times shifted along each mission by random numbers of steps, which keeps
    the autocorrelation of the times.
    """
    rng = np.random.default_rng(0)
    fleet = len(centres)
    times = [np.log(trip.milliseconds) - np.log(trip.milliseconds).mean() for trip in trips]
    waves = np.zeros((sum(map(len, times)), 4 * fleet))
    row = 0
    for trip in trips:
        east, north = (trip.places - np.asarray(centres[trip.uav])).T
        phase = np.arctan2(north, east)
        columns = np.stack((np.cos(phase), np.sin(phase), np.cos(2 * phase), np.sin(2 * phase)), axis=1)
        waves[row : row + len(phase), 4 * trip.uav : 4 * trip.uav + 4] = columns
        row += len(phase)
    basis, _ = np.linalg.qr(waves)

    def share(shifted: Sequence[FloatArray]) -> float:
        y = np.concatenate(shifted)
        return float(((basis.T @ y) ** 2).sum() / (y**2).sum())

    observed = share(times)
    chance = [share([np.roll(y, rng.integers(len(y))) for y in times]) for _ in range(shifts)]
    return observed, (1 + sum(found >= observed for found in chance)) / (1 + shifts)
