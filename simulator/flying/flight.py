"""One flight: the UAVs fly a world step by step as their pilot decides."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np
from pydantic_core import PydanticSerializationError

from shared.scenario import Scenario
from shared.schemas import Uplink
from simulator.client import Exchange
from simulator.flying.pilots import Choice, Pilot
from simulator.records.decision import Decision
from simulator.records.decision_log import DecisionLog
from simulator.records.summary import FlightFacts
from simulator.records.track import Instant, Track
from simulator.sites.site import Site
from simulator.world import Info, Observation, PipelineWorld, StepTally
from simulator.world.sensors import Sensors


@dataclass
class Flight:
    """The whole steps of a mission that were flown.

    ``seed`` is ``None`` where the sensors are real. ``decisions`` are in order of step and UAV. ``tally`` has one entry
    a step. ``sensor_xy`` has shape (J, 2), metres. ``track`` has the true state before the first step and after each,
    as far as it is known.
    """

    scenario: Scenario
    seed: int | None
    decisions: list[Decision] = field(default_factory=list)
    tally: list[StepTally] = field(default_factory=list)
    sensor_xy: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    track: Track = field(default_factory=Track)
    interrupted: bool = False
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    duration_s: float = 0.0

    @property
    def steps_flown(self) -> int:
        """The number of whole steps flown."""
        return len(self.tally)

    def facts(
        self,
        *,
        policy: str,
        edge: str | None,
        uplink: Uplink | None = None,
        mission_id: str,
        mode: str | None,
        model: str | None,
        deadline_ms: int | None,
        command: str,
    ) -> FlightFacts:
        """The facts for ``simulator.records.summary.summarise``."""
        return FlightFacts(
            scenario=self.scenario.name,
            seed=self.seed,
            steps=self.scenario.steps,
            steps_flown=self.steps_flown,
            uavs=self.scenario.uavs,
            sensors=self.scenario.sensors,
            policy=policy,
            edge=edge,
            uplink=uplink,
            mission_id=mission_id,
            mode=mode,
            model=next((d.model for d in reversed(self.decisions) if d.model), model),
            deadline_ms=next((d.deadline_ms for d in reversed(self.decisions) if d.deadline_ms), deadline_ms),
            interrupted=self.interrupted,
            started_at=self.started_at,
            duration_s=self.duration_s,
            version=version("aic-vds"),
            command=command,
        )


def fly(
    site: Site,
    pilot: Pilot,
    seed: int,
    log: DecisionLog | None = None,
    on_decision: Callable[[Choice], None] | None = None,
    on_step: Callable[[Flight], None] | None = None,
    on_decided: Callable[[int, Sensors], None] | None = None,
) -> Flight:
    """Fly one mission; a KeyboardInterrupt ends it after the last whole step, with ``interrupted`` true.

    Args:
        site: the scenario, and its trace if it has one.
        pilot: decides for every UAV, gets the outcomes, and lands at the end.
        seed: of the world.
        log: gets the decisions of each whole step.
        on_decision: called after every decision.
        on_step: called after every step with the flight so far.
        on_decided: called before each step is flown, once every UAV has its decision, with the step and the sensors.
    """
    scenario = site.scenario
    flight = Flight(scenario, seed)
    began = time.monotonic()
    try:
        world = site.world()
        observations, _ = world.reset(seed=seed)
        flight.sensor_xy = np.array(observations["uav_0"]["sensor_position"], dtype=float)
        flight.track.append(_instant(world, observations, {}))
        for step in range(scenario.steps):
            choices: dict[int, Choice] = {}
            for agent, uav in world.live.items():
                taken = frozenset(choice.sensor for choice in choices.values())
                choices[uav] = pilot.decide(uav, observations[agent], taken)
                if on_decision is not None:
                    on_decision(choices[uav])
            if on_decided is not None:
                on_decided(step, world.sensors)
            actions = {f"uav_{i}": np.array([c.sensor, c.velocity], dtype=np.int64) for i, c in choices.items()}
            before = observations
            observations, _, left, _, infos = world.step(actions)
            _record(flight, before, choices, infos, log)
            for uav, choice in choices.items():
                info = infos[f"uav_{uav}"]
                pilot.learn(uav, choice, float(info["cost"]), bool(info["failed"]))
            flight.track.append(_instant(world, observations, left))
            flight.tally.append(world.tally[-1])
            if on_step is not None:
                on_step(flight)
        pilot.land()
    except (KeyboardInterrupt, PydanticSerializationError) as error:
        # pydantic makes its own error of an interrupt that comes while it writes a model.
        if isinstance(error, PydanticSerializationError) and "KeyboardInterrupt" not in str(error):
            raise
        flight.interrupted = True
        flight.decisions = [decision for decision in flight.decisions if decision.step < flight.steps_flown]
        if log is not None:
            log.rewrite(flight.decisions)
    flight.duration_s = time.monotonic() - began
    return flight


def _instant(world: PipelineWorld, observations: Mapping[str, Observation], left: Mapping[str, bool]) -> Instant:
    flying = [agent for agent in observations if not left.get(agent)]
    positions = {int(agent.removeprefix("uav_")): observations[agent]["position"].tolist() for agent in flying}
    sensors = world.sensors
    return Instant(len(world.tally), positions, sensors.queue.copy(), sensors.battery.copy(), sensors.lost.copy())


def _record(
    flight: Flight,
    observations: Mapping[str, Observation],
    choices: Mapping[int, Choice],
    infos: Mapping[str, Info],
    log: DecisionLog | None,
) -> None:
    for uav, choice in choices.items():
        observation, info = observations[f"uav_{uav}"], infos[f"uav_{uav}"]
        x, y = observation["position"].tolist()
        decision = Decision(
            step=int(observation["step"][0]),
            uav_id=uav,
            position=(x, y),
            sensor_id=choice.sensor,
            velocity=choice.velocity,
            source=choice.source,
            reason=choice.reason,
            failed=bool(info["failed"]),
            collected=int(info["collected"]),
            lost_packets=int(info["lost_packets"]),
            cost=float(info["cost"]),
            **exchange_fields(choice.exchange),
        )
        flight.decisions.append(decision)
        if log is not None:
            log.append(decision)


def exchange_fields(exchange: Exchange | None) -> dict[str, Any]:
    """The fields of a ``Decision`` that come from the edge's answer; empty without an exchange."""
    if exchange is None:
        return {}
    answer = exchange.response
    return {
        "model": answer.model,
        "decision_id": answer.decision_id,
        "top_k": answer.top_k,
        "trust": {} if answer.guided is None else answer.guided.trust,
        "tokens": answer.tokens,
        "latency_ms": answer.latency_ms,
        "deadline_ms": answer.deadline_ms,
        "rtt_ms": exchange.rtt_ms,
        "attempts": exchange.attempts,
        "request_bytes": exchange.request_bytes,
        "response_bytes": exchange.response_bytes,
        "attention_bytes": exchange.attention_bytes,
    }
