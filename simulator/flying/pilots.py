"""The pilots of a fleet: a local policy, or an edge with a fallback on board."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from shared.scenario import Scenario
from shared.wire import DecideRequest, FeedbackRequest, MissionSpec, Mode, Outcome
from simulator.client import EdgeClient, Exchange
from simulator.client.observation_report import decide_request
from simulator.errors import EdgeError, EdgeProtocolError, EdgeRefused, EdgeUnreachable
from simulator.policies.policy import Policy
from simulator.policies.registry import policy_named
from simulator.records.decision import DecidedBy
from simulator.world import Observation

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
