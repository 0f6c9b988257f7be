"""The pilots of a fleet: a local policy, or an edge with a fallback on board."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from shared.client.calls import Exchange
from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeError, EdgeRefused, EdgeUnreachable
from shared.wire.schemas import DecideRequest, FeedbackRequest, MissionSpec, Mode, Outcome
from shared.world.scenario import Scenario
from simulator.policies.registry import LearningPolicy, Policy, policy_named
from simulator.records.decision import DecidedBy
from simulator.records.flight import exchange_fields
from simulator.world.observation import Observation, decide_request

FALLBACK = "longest_queue"


@dataclass(frozen=True)
class PilotChoice:
    """A decision: sensor, velocity in m/s, source, the reason of a fallback, and the exchange with an edge, if any."""

    sensor: int
    velocity: int
    source: DecidedBy
    reason: str | None = None
    exchange: Exchange | None = None

    def recorded(self) -> dict[str, Any]:
        """The fields of a ``Decision`` that come from the choice and from the edge's answer."""
        own = {"sensor_id": self.sensor, "velocity": self.velocity, "source": self.source, "reason": self.reason}
        return own | exchange_fields(self.exchange)


class Pilot(Protocol):
    """Decides for the fleet."""

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The choice for one UAV from its observation and the sensors that earlier UAVs of this step took."""

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        """Use the outcome of that choice."""

    def land(self) -> None:
        """Finish the mission."""


def decided(policy: Policy, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
    """A policy's sensor and velocity; raises ``ValueError`` unless they are two whole numbers."""
    sensor, velocity = policy.decide(uav, observation, taken)
    if (int(sensor), int(velocity)) != (sensor, velocity):
        step = int(observation["step"][0])
        raise ValueError(f"UAV {uav}, step {step}: ({sensor}, {velocity}) are not two whole numbers")
    return int(sensor), int(velocity)


class LocalPilot:
    """The pilot of a local policy, by default that of the name; every decision counts as taken on board."""

    def __init__(self, name: str, scenario: Scenario, seed: int, policy: Policy | None = None) -> None:
        self._reason = f"policy_{name.rpartition(':')[2]}"
        self._policy: Policy = policy_named(name) if policy is None else policy
        self._policy.reset(scenario, seed)
        self._steps: dict[int, int] = {}

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The policy's choice; raises ``ValueError`` unless it is two whole numbers."""
        self._steps[uav] = int(observation["step"][0])
        sensor, velocity = decided(self._policy, uav, observation, taken)
        return PilotChoice(sensor, velocity, "onboard", self._reason)

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        """Pass the outcome to the policy, if it learns."""
        if isinstance(self._policy, LearningPolicy):
            self._policy.learn(uav, self._steps[uav], failed)

    def land(self) -> None:
        """Do nothing: no outcome is pending."""


class OnBoard:
    """Decides while no edge answers: the longest queue in reach, at the velocity that the edge decided last for a UAV.

    A planned fleet waits where its sensors are; a velocity of its own would carry a UAV past them, a lap away.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._policy: Policy = policy_named(FALLBACK)
        self._policy.reset(scenario, seed)
        self._velocities: dict[int, int] = {}

    def follow(self, uav: int, velocity: int) -> None:
        """Remember a velocity that the edge has decided."""
        self._velocities[uav] = velocity

    def decide(self, uav: int, observation: Observation, taken: frozenset[int], reason: str) -> PilotChoice:
        """The choice, with the reason why it is not the edge's."""
        sensor, velocity = self._policy.decide(uav, observation, taken)
        return PilotChoice(int(sensor), self._velocities.get(uav, int(velocity)), "onboard", reason)


class EdgePilot:
    """The pilot that asks an edge; without a usable answer the UAV decides on board.

    ``spec`` is the mission to create at the edge before the first decision. ``on_request`` is called with each request
    before it is sent. ``answered`` counts the edge's decisions, ``on_board`` decides without it, and ``last_error`` is
    the text of the last failure. After a step with an unreachable edge the fleet waits until the client ``probe`` finds
    it ready, at most ``reconnect_s`` seconds in all per outage.
    """

    def __init__(
        self,
        client: EdgeClient,
        mission_id: str,
        scenario: Scenario,
        seed: int,
        *,
        mode: Mode | None = None,
        note: str | None = None,
        deadline_ms: int | None = None,
        probe: EdgeClient | None = None,
        reconnect_s: float = 0.0,
        on_wait: Callable[[str], None] | None = None,
    ) -> None:
        self._client = client
        self._probe = probe or client
        self._reconnect_s = self._wait_left_s = reconnect_s
        self._on_wait = on_wait
        self._step = 0
        self._mission_id = mission_id
        self.spec = MissionSpec(scenario=scenario, seed=seed, mode=mode, note=note)
        self._deadline_ms = deadline_ms
        self._scenario = scenario
        self._pending_outcomes: dict[int, Outcome] = {}
        # Outcomes sent to an edge that could not write them to disk; they are sent again at the end.
        self._unstored_outcomes: list[Outcome] = []
        self._lost = False
        self.on_board = OnBoard(scenario, seed)
        self.on_request: Callable[[DecideRequest], None] = lambda request: None
        self.answered = 0
        self.last_error: str | None = None

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The edge's choice, or the fallback's with source ``onboard`` and the reason."""
        step = int(observation["step"][0])
        if step != self._step and self._lost and self._wait_left_s > 0:
            self._await_edge()
        self._step = step
        request = decide_request(
            uav, observation, self._mission_id, deadline_ms=self._deadline_ms, outcome=self._pending_outcomes.get(uav)
        )
        self.on_request(request)
        try:
            exchange = self._ask(request)
        except EdgeError as error:
            self.last_error = str(error)
            return self.on_board.decide(uav, observation, taken, reason_on_board(error))
        self._pending_outcomes.pop(uav, None)
        if request.outcome is not None and not exchange.response.stored:
            self._unstored_outcomes.append(request.outcome)
        self.answered += 1
        answer = exchange.response
        self.on_board.follow(uav, answer.velocity)
        return PilotChoice(answer.sensor_id, answer.velocity, answer.source, answer.reason, exchange)

    def _await_edge(self) -> None:
        # Without an edge a step takes microseconds: the mission would end before a restarted edge is up.
        began = time.monotonic()
        try:
            self._probe.wait_ready(self._wait_left_s, on_wait=self._on_wait)
            # An edge that has restarted without a store has lost the mission; one with it may have it by another spec.
            with suppress(EdgeRefused):
                self._probe.put_mission(self._mission_id, self.spec)
        except EdgeError as error:
            self.last_error = str(error)
        self._wait_left_s -= time.monotonic() - began

    def _ask(self, request: DecideRequest) -> Exchange:
        try:
            # A single attempt detects that a lost edge is back with the least delay.
            exchange = self._client.decide(request, attempts=1 if self._lost else None)
        except EdgeUnreachable:
            self._lost = True
            raise
        except EdgeRefused as refused:
            # A restarted edge has neither the mission nor the earlier decision: create it, and omit the outcome.
            if not (refused.mission_unknown or (request.outcome is not None and refused.concerns("outcome"))):
                raise
            try:
                self._client.put_mission(self._mission_id, self.spec)
            except EdgeRefused:
                if refused.mission_unknown:
                    raise
            exchange = self._client.decide(request.model_copy(update={"outcome": None}))
        self._lost, self._wait_left_s = False, self._reconnect_s
        return exchange.within(self._scenario)

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        """Store the outcome for this UAV's next request."""
        if choice.exchange is not None:
            self._pending_outcomes[uav] = choice.exchange.outcome(cost, failed)

    def land(self) -> None:
        """Send the outcomes that no later request carried, until the edge is unreachable."""
        for outcome in (*self._unstored_outcomes, *self._pending_outcomes.values()):
            try:
                self._client.feedback(FeedbackRequest(mission_id=self._mission_id, **outcome.model_dump()))
            except EdgeUnreachable as error:
                self.last_error = str(error)
                break
            except EdgeError as error:
                self.last_error = str(error)
        self._pending_outcomes.clear()
        self._unstored_outcomes.clear()


def reason_on_board(error: Exception) -> str:
    """The reason of a decision on board after this failure of asking the edge; others are of the report itself."""
    if isinstance(error, EdgeUnreachable | TimeoutError):
        return "edge_unreachable"
    if isinstance(error, EdgeError):
        return "edge_refused" if isinstance(error, EdgeRefused) else "edge_protocol"
    return "report_invalid"
