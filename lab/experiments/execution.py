"""Executing one planned flight: a local policy, an edge over HTTP, or the bound of its world."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from lab.experiments.edges import EdgeAt, radio
from lab.experiments.flight import BoundFound, DecisionRecord, FlightRecord, TokenCounts
from lab.experiments.informed_planner import InformedPilot
from lab.experiments.plan import Planned
from lab.experiments.schemes import Clairvoyant, Informed, Local, OverEdge
from lab.experiments.uplinks_of_sensors import SensorUplinks
from shared.client.errors import EdgeError
from simulator.errors import UsageError
from simulator.flying.flight import fly
from simulator.flying.job import new_mission_id
from simulator.flying.pilots import EdgePilot, LocalPilot, Pilot, PilotChoice
from simulator.records.decision import Decision
from simulator.records.flight import Flight
from simulator.world.observation import Observation


class CannotFly(Exception):
    """The scheme cannot decide in this world; the text says why."""


class FullSpeed(LocalPilot):
    """Another policy's sensors at the scenario's highest velocity."""

    def __init__(self, name: str, site_max_velocity: int, planned: Planned) -> None:
        super().__init__(name, planned.site.scenario, planned.seed)
        self._velocity = site_max_velocity

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The policy's sensor at full speed."""
        return replace(super().decide(uav, observation, taken), velocity=self._velocity)


def fly_locally(planned: Planned) -> FlightRecord:
    """Fly without an edge.

    Raises:
        CannotFly: the policy cannot decide in this world, such as a network trained for another number of sensors.
        KeyboardInterrupt: the flight was interrupted.
    """
    if isinstance(planned.scheme.decides, Clairvoyant):
        return _bound(planned, planned.scheme.decides.seconds)
    try:
        pilot = _pilot(planned)
    except (UsageError, ValueError, ImportError, OSError) as error:
        raise CannotFly(str(error)) from error
    return _record(planned, fly(planned.site, pilot, planned.seed), model=None)


def _pilot(planned: Planned) -> Pilot:
    decides, scenario = planned.scheme.decides, planned.site.scenario
    if isinstance(decides, Informed):
        return InformedPilot(planned.site, planned.seed)
    assert isinstance(decides, Local)
    if decides.velocity == "full":
        return FullSpeed(decides.policy, scenario.max_velocity, planned)
    return LocalPilot(decides.policy, scenario, planned.seed)


def fly_with_edge(edge: EdgeAt, planned: Planned) -> FlightRecord:
    """Fly with decisions of the edge.

    Raises:
        EdgeError: the edge died or did not answer; decisions on board are not this scheme's.
        KeyboardInterrupt: the flight was interrupted.
    """
    assert isinstance(planned.scheme.decides, OverEdge)
    decides, scenario = planned.scheme.decides, planned.site.scenario
    mission_id = new_mission_id(scenario, planned.seed)
    lossy = scenario.uplink_drop > 0

    def check(choice: PilotChoice) -> None:
        if choice.source == "onboard" and not (lossy and choice.reason == "edge_unreachable"):
            edge.alive()
            raise EdgeError(
                f"the edge gave no decision in {planned.scheme.name}, seed {planned.seed}: {pilot.last_error}"
            )

    with (
        radio(edge.url, None, scenario.model_copy(update={"uplink_drop": 0.0, "uplink_jitter_ms": 0.0}), 0) as ground,
        radio(edge.url, decides.deadline_ms, scenario, planned.seed) as air,
    ):
        pilot = EdgePilot(air, mission_id, scenario, planned.seed, deadline_ms=decides.deadline_ms)
        operator, guided = decides.operator, dict[str, Any]()
        spec = {**pilot.spec.model_dump(), **decides.spec}
        if operator is not None:
            spec["note"] = operator.note(planned.seed)
            guided["meant"] = operator.intent(planned.seed).meant
        pilot.spec = pilot.spec.model_validate(spec)
        try:
            ground.put_mission(mission_id, pilot.spec)
            if operator is not None:
                guided["guidance"] = operator.answer(ground, mission_id, planned.seed)
        except EdgeError:
            edge.alive()
            raise
        plan = decides.sensor_uplinks
        uplinks = None if plan is None else SensorUplinks(ground, mission_id, scenario, planned.seed, plan).send
        flight = fly(planned.site, pilot, planned.seed, on_decision=check, on_decided=uplinks)
    edge.alive()
    return _record(planned, flight, edge.model).model_copy(update=guided)


def _bound(planned: Planned, seconds: float) -> FlightRecord:
    try:
        from lab.exploration.wind import bound_in_wind
        from simulator.bound.clairvoyant_bound import clairvoyant

        world = planned.site.scenario
        find = bound_in_wind if world.wind_mps or world.gust_mps else clairvoyant
        found = find(planned.site, planned.seed, seconds)
    except ImportError as error:
        raise CannotFly(f"{error}; install the extra: pip install -e '.[lab]'") from error
    bound = BoundFound.model_validate(found, from_attributes=True)
    flight = Flight(planned.site.scenario, planned.seed, duration_s=found.seconds)
    return _record(planned, flight, model=None).model_copy(update={"bound": bound})


def _record(planned: Planned, flight: Flight, model: str | None) -> FlightRecord:
    if flight.interrupted:
        raise KeyboardInterrupt
    return FlightRecord(
        seed=planned.seed,
        scenario=planned.site.scenario.name,
        steps=planned.site.scenario.steps,
        sensors=planned.site.scenario.sensors,
        uavs=planned.site.scenario.uavs,
        model=next((d.model for d in flight.decisions if d.model), model),
        commit=commit(),
        flown_at=flight.started_at,
        duration_s=round(flight.duration_s, 3),
        failures=[t.failures for t in flight.tally],
        overflows=[t.overflows for t in flight.tally],
        lost_packets=[t.lost_packets for t in flight.tally],
        decisions=[_decided(decision) for decision in flight.decisions],
    )


def _decided(decision: Decision) -> DecisionRecord:
    return DecisionRecord(
        step=decision.step,
        uav=decision.uav_id,
        sensor=decision.sensor_id,
        velocity=decision.velocity,
        failed=decision.failed,
        collected=decision.collected,
        source=decision.source,
        reason=decision.reason,
        tokens=None if decision.tokens is None else TokenCounts.model_validate(decision.tokens.model_dump()),
        rtt_ms=None if decision.rtt_ms is None else round(decision.rtt_ms, 2),
        latency_ms={stage: round(took, 2) for stage, took in decision.latency_ms.items()},
        trust={adviser: round(weight, 4) for adviser, weight in decision.trust.items()},
    )


@cache
def commit() -> str | None:
    """The commit of this code, with ``-dirty`` if files differ from it; ``None`` outside a repository."""
    command = [
        "git",
        "--no-optional-locks",
        "-C",
        str(Path(__file__).parent),
        "describe",
        "--always",
        "--dirty",
        "--abbrev=12",
        "--exclude=*",
    ]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None
