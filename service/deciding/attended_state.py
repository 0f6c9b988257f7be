"""A UAV's augmented state at a decision, and the sensors that attention keeps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.deciding.stopwatch import Stopwatch
from service.guidance.step_guidance import StepGuidance
from service.learning.modules import Attended, Sample, top_k
from service.mission.decisions import Pending
from service.mission.mission import Mission
from service.prompting.compact_prompt import CompactTemplate
from service.prompting.rows import cells
from shared.features.augmented_state import Reach, State, augment
from shared.planning.orders import Guidance
from shared.wire.schemas import Candidate, UavState
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from shared.world.step_rule import Action
from shared.world.urgency import overflow_probability, urgency_of


def as_queues(
    state: State, reach: Reach, orders: Guidance, step: int, visits: NDArray[np.int64], scenario: Scenario
) -> tuple[State, Reach]:
    """The state and the reach in which wishes for sensors are queues, for an LLM that was trained on queues.

    A sensor with a weight w has w times its packets and arrivals, at most W packets. One to be visited within n steps
    has at least a queue that fills from 0 at its last visit to W when a visit is due: ``W min(1, waited / n)`` packets,
    with W / n arrivals a step.

    Args:
        reach: of the state.
        visits: the step of each sensor's last visit, by sensor ID; -1 for never.
    """
    if not orders.wishes:
        return state, reach
    capacity = float(scenario.queue_capacity)
    weights = orders.weights(scenario.sensors)[state.ids]
    interval = orders.visit_intervals(scenario.sensors)[state.ids]
    waited = np.minimum((step - visits[state.ids]) / interval, 1.0)
    queue = np.maximum(np.minimum(weights * state.queue, capacity), capacity * waited)
    rate = np.maximum(weights * state.rate, capacity / interval)
    overflow = overflow_probability(queue, rate, scenario)
    urgency = urgency_of(queue, overflow, scenario)
    shown = Reach.of(reach.links, np.where(state.able, queue, 0.0), urgency)
    ordered = replace(
        state, queue=queue, rate=rate, overflow=overflow, urgency=urgency, reach=None if state.reach is None else shown
    )
    return ordered, shown


@dataclass(frozen=True, slots=True)
class PromptView:
    """The view of J sensors from which a prompt is written.

    Attributes:
        state, reach: as the prompt shows them. The compact prompt has the orders in them, as queues; the reach is None
            where it is the state's own.
        offered: the reach by which the candidates' velocities are chosen; None if it is the state's own.
        guidance: the guidance for the candidates' velocities in this step.
        added: shape ``(J,)``, packets to add to the worth of each sensor as attention chooses the prompt's rows; None
            where there are no orders.
    """

    state: State
    reach: Reach | None
    offered: Reach | None
    guidance: StepGuidance | None
    added: FloatArray | None

    @classmethod
    def of(cls, mission: Mission, state: State, uav_id: int, step: int, confirmed: StepGuidance | None) -> Self:
        """By the confirmed orders, and with the compact prompt by the LLM's own reading of the note before that.

        An unconfirmed order appears only in the prompt: in mode ``guided`` it affects only the LLM's advice, not the
        candidates. Orders in force stay until the operator confirms others.
        """
        scenario, visits = mission.scenario, mission.records.visits
        added = None if confirmed is None else confirmed.worth.max(axis=0)
        read = mission.guidance.read
        if read is None or not isinstance(mission.template, CompactTemplate):
            return cls(state, None, None, confirmed, added)
        reach = state.reach_ahead(uav_id, scenario)
        shown, seen = as_queues(state, reach, read, step, visits, scenario)
        if mission.mode != "llm":
            return cls(shown, seen, seen if read is mission.guidance.orders else None, confirmed, added)
        guidance = StepGuidance.of(read, state, reach, step, visits, scenario)
        ordered = np.where(guidance.allowed[:, None], seen.worth - reach.worth, -np.inf)
        return cls(shown, seen, seen, guidance, ordered.max(axis=0))


@dataclass(frozen=True)
class AttendedState:
    """One UAV's state at one step of its mission, J sensors in the request's order.

    Attributes:
        reserved: IDs of the sensors that other UAVs have in this step.
        guidance: the operator's guidance for this step, if there is any.
        prompt_view: the prompt's view, which may include orders that are not confirmed yet.
        admissible: rows of the state that may be chosen, n of them.
        features: shape ``(n, d)``, the attention module's input.
        contexts: its output ``z_j`` of some of the n, ``(m, d')``.
        rows: rows of the state that attention keeps, best first; without attention all that are admissible.
        candidates: the same sensors with their scores ``s_j``.
    """

    mission: Mission
    uav_id: int
    step: int
    state: State
    reserved: frozenset[int]
    guidance: StepGuidance | None
    prompt_view: PromptView
    admissible: list[int]
    features: NDArray[np.float32]
    contexts: Callable[[list[int]], NDArray[np.float32]]
    rows: list[int]
    candidates: list[Candidate]
    _velocity_values: dict[int, NDArray[np.float32]] = field(default_factory=dict)

    @classmethod
    def of(cls, mission: Mission, uav: UavState, step: int, watch: Stopwatch | None = None) -> Self:
        """Augment a UAV's report with its mission's knowledge, and keep the mission's top k sensors.

        Args:
            watch: takes the times of the stages ``augment`` and ``attend``.
        """
        watch = watch or Stopwatch()
        orders, scenario = mission.guidance.orders, mission.scenario
        reserved = mission.reservations.of_others(step, uav.uav_id)
        state = augment(
            uav,
            step,
            scenario,
            visits=mission.records.visits,
            rates=None if mission.belief_source == "fleet" else mission.records.rates,
            reserved=reserved,
            preset=mission.features,
            belief=mission.belief if mission.belief_source == "fleet" else None,
        )
        guidance = None
        if orders is not None:
            reach = state.reach_ahead(uav.uav_id, scenario)
            guidance = StepGuidance.of(orders, state, reach, step, mission.records.visits, scenario)
        view = PromptView.of(mission, state, uav.uav_id, step, guidance)
        watch.ended.append(("augment", perf_counter()))
        admissible: list[int] = np.flatnonzero(state.admissible).tolist()
        features = state.features(scenario)
        kept, attended = _attend(mission, features, None if view.added is None else view.added[admissible])
        rows = [admissible[i] for i in kept]
        candidates = [
            Candidate(sensor_id=sensor, score=round(score, 6))
            for sensor, score in zip(state.ids[rows].tolist(), attended.scores[kept].tolist(), strict=True)
        ]
        watch.ended.append(("attend", perf_counter()))
        found = (view, admissible, features, attended.contexts, rows, candidates)
        return cls(mission, uav.uav_id, step, state, reserved, guidance, *found)

    @cached_property
    def reach(self) -> Reach:
        """The UAV's reach after the next step, whatever the mission's features are."""
        return self.state.reach or self.state.reach_ahead(self.uav_id, self.mission.scenario)

    @property
    def kept_ids(self) -> list[int]:
        """IDs of the sensors that attention keeps, best first."""
        return [candidate.sensor_id for candidate in self.candidates]

    def show_probabilities(self, sensors: Sequence[int], probabilities: NDArray[np.float64]) -> None:
        """Add to each candidate the LLM's probabilities ``(n,)`` of the n answers that name these sensors."""
        for at, candidate in enumerate(self.candidates):
            llm = round(float(probabilities[np.equal(sensors, candidate.sensor_id)].sum()), 4)
            self.candidates[at] = candidate.model_copy(update={"llm": llm})

    def shown(self) -> list[int]:
        """``rows`` in the order of the prompt: as they are, or shuffled by the mission's seed, the step and the UAV."""
        spec = self.mission.spec
        if spec.prompt.order == "score":
            return self.rows
        shuffle = np.random.default_rng([spec.seed, self.step, self.uav_id])
        return [self.rows[i] for i in shuffle.permutation(len(self.rows))]

    def best_by_value(self) -> Action:
        """The best-scored sensor and the best velocity for it that is allowed, by the learned values."""
        row = self.rows[0]
        level = int(self.values_of_velocities([row])[0].argmax())
        if self.guidance is not None:
            level = self.guidance.nearest(row, level)
        return Action(int(self.state.ids[row]), level)

    def pending(self, decision_id: str, action: Action) -> Pending:
        """The decision with its training sample, if its sensor is admissible."""
        sensor_id, velocity = action
        rows = np.flatnonzero(self.state.ids == sensor_id)
        row = int(rows[0]) if len(rows) else None
        sample = None
        if row is not None and row in self.admissible:
            sample = Sample(
                features=self.features,
                chosen=self.admissible.index(row),
                approach=self.state.approaches([row], self.mission.scenario)[0],
                velocity=velocity,
            )
        heard = self.state.heard[rows].any()
        seen = cells(self.state, rows.tolist())[0] if heard else self.mission.template.unreported_row(sensor_id)
        return Pending(
            decision_id=decision_id,
            uav_id=self.uav_id,
            step=self.step,
            sensor_id=sensor_id,
            velocity=velocity,
            seen=seen,
            sample=sample,
        )

    def values_of_velocities(self, rows: Sequence[int]) -> list[NDArray[np.float32]]:
        """The learned ``u_jv`` of the sensors in these rows at each velocity level v, ``(V,)`` each."""
        if missing := [row for row in rows if row not in self._velocity_values]:
            contexts = self.contexts([self.admissible.index(row) for row in missing])
            approaches = self.state.approaches(missing, self.mission.scenario)
            values = self.mission.learner.weights.velocities(contexts, approaches)
            self._velocity_values.update(zip(missing, values, strict=True))
        return [self._velocity_values[row] for row in rows]


def _attend(mission: Mission, features: NDArray[np.float32], packets: FloatArray | None) -> tuple[list[int], Attended]:
    """Places among the n sensors of those to keep, best first, and their attention, with added ``packets`` ``(n,)``."""
    if not len(features):
        return [], Attended(np.empty(0, dtype=np.float32), features.__getitem__)
    attended = mission.learner.weights.attend(features)
    if packets is not None:
        # A score is minus a cost, and the packets of a cost are counted in queues of capacity W.
        added = (packets / mission.scenario.queue_capacity).astype(np.float32)
        attended = attended._replace(scores=attended.scores + added)
    if not mission.uses_attention:
        return list(range(len(features))), attended
    return top_k(attended.scores, mission.top_k), attended
