"""One mission: the UAVs fly the world step by step and ask the edge, or a local policy, where to go."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np

from shared.channel import FloatArray
from shared.scenario import Scenario
from shared.wire import DecideRequest, FeedbackRequest, MissionSpec, Mode, Outcome, SensorColumns, Uplink
from simulator.client import EdgeClient, EdgeError, EdgeProtocolError, EdgeRefused, EdgeUnreachable, Exchange
from simulator.policies import Policy, policy_named
from simulator.record import DecidedBy, Decision, DecisionLog, Flown
from simulator.rollout import rollout
from simulator.site import Site
from simulator.world import Info, Observation, StepTally

BASELINES = ("eof", "wqcs")
FALLBACK = "eof"


@dataclass(frozen=True)
class Choice:
    """A sensor, a velocity in m/s, who chose them, why it was not the LLM, and the exchange if there was one."""

    sensor: int
    velocity: int
    source: DecidedBy
    reason: str | None = None
    exchange: Exchange | None = None


class Pilot(Protocol):
    """Whoever decides for the fleet."""

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> Choice:
        """The choice of one UAV, given what it sees and the sensors that earlier UAVs took this step."""

    def learn(self, uav: int, choice: Choice, cost: float, failed: bool) -> None:
        """What came of that choice."""

    def land(self) -> None:
        """The mission is over."""


class LocalPilot:
    """Flies a policy of the simulator's own; every decision counts as taken on board."""

    def __init__(self, name: str, scenario: Scenario, seed: int) -> None:
        self._reason = f"policy_{name}"
        self._policy: Policy = policy_named(name)
        self._policy.reset(scenario, seed)

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> Choice:
        """The policy's choice."""
        sensor, velocity = self._policy.decide(uav, observation, taken)
        return Choice(int(sensor), int(velocity), "onboard", self._reason)

    def learn(self, uav: int, choice: Choice, cost: float, failed: bool) -> None:
        """A local policy does not learn."""

    def land(self) -> None:
        """Nothing is owed to anyone."""


class EdgePilot:
    """Asks an edge, and decides on board with EOF when it gives no usable answer: a UAV in the air must fly on.

    ``spec`` is the mission to make at the edge before the first decision; ``on_request`` hears each request before it
    is asked; ``answered`` counts the edge's decisions; ``last_error`` is the last reason for going without. After a
    step in which the edge was out of reach, the fleet waits until ``scout`` finds it ready, ``reconnect_s`` seconds in
    all per outage at most.
    """

    def __init__(
        self,
        client: EdgeClient,
        mission_id: str,
        scenario: Scenario,
        seed: int,
        *,
        mode: Mode | None = None,
        deadline_ms: int | None = None,
        scout: EdgeClient | None = None,
        reconnect_s: float = 0.0,
        on_wait: Callable[[str], None] | None = None,
    ) -> None:
        self._client = client
        self._scout = scout or client
        self._reconnect_s = self._patience_s = reconnect_s
        self._on_wait = on_wait
        self._step = 0
        self._mission_id = mission_id
        self.spec = MissionSpec(scenario=scenario, seed=seed, mode=mode)
        self._deadline_ms = deadline_ms
        self._max_velocity = scenario.max_velocity
        self._owed: dict[int, Outcome] = {}
        # Told to an edge that could not put them on disk.
        self._unsure: list[Outcome] = []
        self._lost = False
        self._fallback: Policy = policy_named(FALLBACK)
        self._fallback.reset(scenario, seed)
        self.on_request: Callable[[DecideRequest], None] = lambda request: None
        self.answered = 0
        self.last_error: str | None = None

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> Choice:
        """The edge's choice, or EOF's with source ``onboard`` and the reason."""
        step = int(observation["step"][0])
        if step != self._step and self._lost and self._patience_s > 0:
            self._await_edge()
        self._step = step
        request = decide_request(
            uav, observation, self._mission_id, deadline_ms=self._deadline_ms, outcome=self._owed.get(uav)
        )
        self.on_request(request)
        try:
            exchange = self._ask(request)
        except EdgeError as error:
            self.last_error = str(error)
            sensor, velocity = self._fallback.decide(uav, observation, taken)
            return Choice(int(sensor), int(velocity), "onboard", _reason(error))
        self._owed.pop(uav, None)
        if request.outcome is not None and not exchange.response.stored:
            self._unsure.append(request.outcome)
        self.answered += 1
        answer = exchange.response
        return Choice(answer.sensor_id, answer.velocity, answer.source, answer.reason, exchange)

    def _await_edge(self) -> None:
        # Without an edge a step takes microseconds, so the mission would be over before a restarted edge is up.
        began = time.monotonic()
        try:
            self._scout.wait_ready(self._patience_s, on_wait=self._on_wait)
            # A restarted edge must not make the mission anew from a request, with another spec.
            self._scout.put_mission(self._mission_id, self.spec)
        except EdgeError as error:
            self.last_error = str(error)
        self._patience_s -= time.monotonic() - began

    def _ask(self, request: DecideRequest) -> Exchange:
        try:
            # One attempt is enough to notice that a lost edge is back, and it delays the fleet least.
            exchange = self._client.decide(request, attempts=1 if self._lost else None)
        except EdgeUnreachable:
            self._lost = True
            raise
        except EdgeRefused as refused:
            # An edge that restarted knows neither the earlier decision nor the mission; that must not cost this one.
            if request.outcome is None or not refused.blames("outcome"):
                raise
            self._client.put_mission(self._mission_id, self.spec)
            exchange = self._client.decide(request.model_copy(update={"outcome": None}))
        self._lost, self._patience_s = False, self._reconnect_s
        if exchange.response.velocity > self._max_velocity:
            raise EdgeProtocolError(
                f"the edge chose {exchange.response.velocity} m/s, the limit is {self._max_velocity}"
            )
        return exchange

    def learn(self, uav: int, choice: Choice, cost: float, failed: bool) -> None:
        """Keep the outcome for this UAV's next request."""
        if choice.exchange is not None:
            self._owed[uav] = choice.exchange.outcome(cost, failed)

    def land(self) -> None:
        """Send the outcomes that no later request carried, as far as the edge still listens."""
        for outcome in (*self._unsure, *self._owed.values()):
            try:
                self._client.feedback(FeedbackRequest(mission_id=self._mission_id, **outcome.model_dump()))
            except EdgeUnreachable as error:
                self.last_error = str(error)
                break
            except EdgeError as error:
                self.last_error = str(error)
        self._owed.clear()
        self._unsure.clear()


def _reason(error: EdgeError) -> str:
    if isinstance(error, EdgeUnreachable):
        return "edge_unreachable"
    return "edge_refused" if isinstance(error, EdgeRefused) else "edge_protocol"


def decide_request(
    uav: int,
    observation: Observation,
    mission_id: str,
    *,
    deadline_ms: int | None = None,
    outcome: Outcome | None = None,
) -> DecideRequest:
    """What one UAV sends: its observation as columns, ``null`` where it never heard a beacon.

    Raises:
        pydantic.ValidationError: the observation breaks a bound of the wire.
    """
    heard = observation["last_heard"].tolist()
    places = observation["sensor_position"]

    def column(values: FloatArray) -> list[float | None]:
        return [value if step >= 0 else None for value, step in zip(values.tolist(), heard, strict=True)]

    return DecideRequest(
        mission_id=mission_id,
        uav_id=uav,
        step=int(observation["step"][0]),
        position=observation["position"].tolist(),
        progress_m=float(observation["progress"][0]),
        sensors=SensorColumns(
            id=list(range(len(heard))),
            x=places[:, 0].tolist(),
            y=places[:, 1].tolist(),
            queue=column(observation["queue"]),
            battery=column(observation["battery"]),
            channel_gain=column(observation["channel_gain"]),
            last_seen=[step if step >= 0 else None for step in heard],
        ),
        outcome=outcome,
        deadline_ms=deadline_ms,
    )


@dataclass
class Flight:
    """A mission as far as it was flown: whole steps only.

    ``decisions`` in order of step and UAV; ``tally`` one entry a step; ``sensor_xy`` (J, 2) metres.
    """

    scenario: Scenario
    seed: int
    decisions: list[Decision] = field(default_factory=list)
    tally: list[StepTally] = field(default_factory=list)
    sensor_xy: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    interrupted: bool = False
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    duration_s: float = 0.0

    @property
    def steps_flown(self) -> int:
        """Whole steps that every UAV flew."""
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
    ) -> Flown:
        """The facts for ``simulator.record.summarise``."""
        return Flown(
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


def new_mission_id(scenario: Scenario, seed: int) -> str:
    """An id that no earlier run had, such as ``paper-0-1f6c09ab``."""
    return f"{scenario.name}-{seed}-{secrets.token_hex(4)}"


def fly(
    site: Site,
    pilot: Pilot,
    seed: int,
    log: DecisionLog | None = None,
    on_decision: Callable[[Choice], None] | None = None,
    on_step: Callable[[Flight], None] | None = None,
) -> Flight:
    """Fly one mission, or as much of it as a KeyboardInterrupt lets it: then ``interrupted`` is true.

    Args:
        site: where.
        pilot: who decides; it hears the outcomes, and at the end it is told to land.
        seed: of the world.
        log: takes every decision of each whole step.
        on_decision: called after every decision.
        on_step: called after every step with the flight so far.
    """
    scenario = site.scenario
    flight = Flight(scenario, seed)
    began = time.monotonic()
    try:
        world = site.world()
        observations, _ = world.reset(seed=seed)
        flight.sensor_xy = np.array(observations["uav_0"]["sensor_position"], dtype=float)
        for _step in range(scenario.steps):
            choices: list[Choice] = []
            for uav in range(scenario.uavs):
                taken = frozenset(choice.sensor for choice in choices)
                choices.append(pilot.decide(uav, observations[f"uav_{uav}"], taken))
                if on_decision is not None:
                    on_decision(choices[-1])
            actions = {f"uav_{i}": np.array([c.sensor, c.velocity], dtype=np.int64) for i, c in enumerate(choices)}
            before = observations
            observations, _, _, _, infos = world.step(actions)
            _book(flight, before, choices, infos, log)
            for uav, choice in enumerate(choices):
                info = infos[f"uav_{uav}"]
                pilot.learn(uav, choice, float(info["cost"]), bool(info["failed"]))
            flight.tally.append(world.tally[-1])
            if on_step is not None:
                on_step(flight)
        pilot.land()
    except KeyboardInterrupt:
        flight.interrupted = True
        del flight.decisions[flight.steps_flown * scenario.uavs :]
        if log is not None:
            log.keep(flight.decisions)
    flight.duration_s = time.monotonic() - began
    return flight


def _book(
    flight: Flight,
    observations: Mapping[str, Observation],
    choices: list[Choice],
    infos: Mapping[str, Info],
    log: DecisionLog | None,
) -> None:
    for uav, choice in enumerate(choices):
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
            **of_the_exchange(choice.exchange),
        )
        flight.decisions.append(decision)
        if log is not None:
            log.append(decision)


def of_the_exchange(exchange: Exchange | None) -> dict[str, Any]:
    """What a ``Decision`` takes over from the edge's answer; nothing where there was none."""
    if exchange is None:
        return {}
    answer = exchange.response
    return {
        "model": answer.model,
        "decision_id": answer.decision_id,
        "top_k": answer.top_k,
        "tokens": answer.tokens,
        "latency_ms": answer.latency_ms,
        "deadline_ms": answer.deadline_ms,
        "rtt_ms": exchange.rtt_ms,
        "attempts": exchange.attempts,
        "request_bytes": exchange.request_bytes,
        "response_bytes": exchange.response_bytes,
        "attention_bytes": exchange.attention_bytes,
    }


def baselines(site: Site, seed: int, steps: int) -> dict[str, list[StepTally]]:
    """EOF and WQCS on the same site and seed: per policy, the first ``steps`` steps' tallies."""
    flown = {name: rollout(site.world(), policy_named(name), seed) for name in BASELINES}
    return {name: tally[:steps] for name, tally in flown.items()}
