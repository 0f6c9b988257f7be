"""One flight: the UAVs fly a world step by step as their pilot decides."""

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from pydantic_core import PydanticSerializationError

from simulator.flying.job import BASELINES
from simulator.flying.pilots import Pilot, PilotChoice, decided
from simulator.policies.registry import LearningPolicy, Policy, policy_named
from simulator.records.decision import Decision
from simulator.records.flight import Flight
from simulator.records.mission_logs import DecisionLog
from simulator.records.track import Instant
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from simulator.world.observation import Info, Observation, StepTally
from simulator.world.sensors import Sensors


def fly(
    site: Site,
    pilot: Pilot,
    seed: int,
    log: DecisionLog | None = None,
    on_decision: Callable[[PilotChoice], None] | None = None,
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
            choices: dict[int, PilotChoice] = {}
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
    choices: Mapping[int, PilotChoice],
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
            failed=bool(info["failed"]),
            collected=int(info["collected"]),
            lost_packets=int(info["lost_packets"]),
            cost=float(info["cost"]),
            **choice.recorded(),
        )
        flight.decisions.append(decision)
        if log is not None:
            log.append(decision)


def baselines(site: Site, seed: int, steps: int, names: Sequence[str] = BASELINES) -> dict[str, list[StepTally]]:
    """Local policies, by default the paper's EOF and WQCS, on the same site and seed.

    Returns:
        The tallies of the first ``steps`` steps by policy.
    """
    flown = {name: rollout(site.world(), policy_named(name), seed) for name in names}
    return {name: tally[:steps] for name, tally in flown.items()}


def rollout(world: PipelineWorld, policy: Policy, seed: int) -> list[StepTally]:
    """Fly one mission from ``reset(seed)`` to its end; UAV 0 decides first, and later UAVs know the sensors taken.

    Args:
        world: this function resets it with the seed.
        policy: this function resets it with the world's scenario and the seed.
        seed: of the world, and of a random policy.

    Returns:
        The world's tally, one entry a step.
    """
    observations, _ = world.reset(seed=seed)
    policy.reset(world.scenario, seed)
    while world.agents:
        actions: dict[str, tuple[int, int]] = {}
        taken: frozenset[int] = frozenset()
        step, live = len(world.tally), dict(world.live)
        for agent, uav in live.items():
            actions[agent] = decided(policy, uav, observations[agent], taken)
            taken |= {actions[agent][0]}
        observations, _, _, _, infos = world.step(actions)
        if isinstance(policy, LearningPolicy):
            for agent, uav in live.items():
                policy.learn(uav, step, infos[agent]["failed"])
    return list(world.tally)
