"""One fleet's state: visiting records, arrival rates, reservations, experiences, pending decisions, learner."""

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from service.config.settings import Settings
from service.errors import Refused
from service.guidance.named_places import in_ids
from service.guidance.operator_guidance import OperatorGuidance
from service.learning.initial_weights import initial_weights
from service.learning.learner import Learner
from service.learning.modules import Sample
from service.learning.trust import PRIOR, PRIOR_UNPLANNED, Trust
from service.mission.decisions import PENDING_PER_UAV, Pending, PendingDecisions, Reservation, Reservations
from service.mission.events import (
    AdviserReport,
    Decided,
    Event,
    GuidanceChanged,
    ReadingsMerged,
    Reported,
    Settled,
    ignore_event,
)
from service.mission.idempotency import IdempotentAnswers
from service.mission.planner import MAX_CAPACITY, MAX_SENSORS, MAX_UAVS, MissionPlanner
from service.mission.prompt_fit import PromptFit, template_for
from service.mission.reports import Reports
from service.mission.resolved_spec import ResolvedSpec
from service.mission.sensor_readings import PlacedReading, Readings
from service.mission.visit_orders import VisitOrders
from service.prompting.experiences import Experience, Experiences
from shared.belief.fleet_belief import FleetBelief, Measured
from shared.belief.records import Records, take_report
from shared.planning.guidance_messages import GuidanceAnswer, GuidanceStatus
from shared.planning.orders import Guidance
from shared.wire.missions import VisitDeadline
from shared.wire.readings import ReadingResult, SensorReading
from shared.wire.schemas import Belief, Features, MissionSpec, Mode, Outcome, UavState
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario, scenario_named
from shared.world.step_rule import Action

log = logging.getLogger(__name__)
# The attributes of a mission that have a ``state_dict`` of their own.
_PARTS = ("pending", "idempotent_answers", "experiences", "records", "reservations", "belief", "visit_orders")


class Mission:
    """One fleet's state. Only the event loop uses it.

    Every change is an event, which ``record`` receives. The same events in the same order, on the same spec, make the
    same mission again (see :mod:`service.edge.stored_missions`).

    Attributes:
        requested_spec: the spec of the request; ``spec`` is the resolved one.
        prompt_fits: whether the LLM's context is large enough for every prompt; True in a mode without an LLM.
        measured: by UAV, the measurements of its newest report, until exported to metrics.
        trust: in mode ``guided``, the trust in the advisers, by the name of the LLM that is one of them; "" where that
            is unknown.

    Args:
        spec: the resolved spec of a restored mission, which stays as it is whatever the settings are now.

    Raises:
        Refused: the spec names an unknown scenario, or its prompt cannot fit the LLM's context.
    """

    def __init__(
        self, mission_id: str, requested_spec: MissionSpec, settings: Settings, spec: ResolvedSpec | None = None
    ) -> None:
        self.mission_id = mission_id
        self.requested_spec = requested_spec
        restored, spec = spec is not None, spec or ResolvedSpec.of(requested_spec, settings)
        self.spec = spec
        try:
            scenario = spec.scenario
            self.scenario: Scenario = scenario_named(scenario) if isinstance(scenario, str) else scenario
        except ValueError as error:
            raise Refused("scenario", str(error)) from None
        self.mode: Mode = spec.mode
        self.features: Features = spec.features
        self.belief_source: Belief = spec.belief
        self.top_k = spec.top_k
        self.uses_attention = spec.uses_attention
        weights = initial_weights(spec.init, self.features, self.scenario.max_velocity + 1, spec.seed)
        self.template = template_for(spec, self.scenario)
        self.prompt_fit = PromptFit(spec, self.scenario, settings.llm_context, settings.adapted)
        self.prompt_fits = not spec.uses_llm or self.prompt_fit.fits()
        if spec.uses_llm and not restored:
            self.prompt_fit.check()
        self.experiences = Experiences(spec.prompt.experiences, spec.prompt.selection)
        self.decisions = 0
        self.feedback = 0
        self.learner = Learner(weights, learning_rate=settings.learning_rate)
        self.records = Records(self.scenario)
        self.reservations = Reservations()
        self.pending = PendingDecisions(mission_id, self.scenario)
        self.idempotent_answers = IdempotentAnswers(PENDING_PER_UAV * self.scenario.uavs)
        self.belief = FleetBelief(self.scenario)
        self.measured: dict[int, Measured] = {}
        self.reports = Reports(mission_id, self.scenario, self.belief, self.pending)
        self.readings = Readings(self.scenario, self.belief, self.records)
        world = self.scenario
        small = world.sensors <= MAX_SENSORS and world.uavs <= MAX_UAVS and world.queue_capacity <= MAX_CAPACITY
        self.planner = MissionPlanner(self.scenario, self.belief) if small and spec.planner == "on" else None
        self.guidance = OperatorGuidance(spec.note, self.scenario)
        self.visit_orders = VisitOrders()
        prior = PRIOR if self.planner is not None else PRIOR_UNPLANNED
        self.trust = defaultdict[str, Trust](partial(Trust, prior, most_open=PENDING_PER_UAV * self.scenario.uavs))
        self.record: Callable[[Event], None] = ignore_event

    def answer_guidance(self, answer: GuidanceAnswer) -> None:
        """Apply the operator's answer, where a name that is no number stands for its ID; raises as the guidance's."""
        if answer.orders and self.spec.names:
            named = enumerate(self.spec.names.sensors)
            listed = [(sensor, name) for sensor, name in named if name and not name.isdigit()]
            ids = {f"{kind}:{name}": f"{kind}:{sensor}" for sensor, name in listed for kind in ("visit", "weight")}
            answer = answer.model_copy(update={"orders": [ids.get(order, order) for order in answer.orders]})
        self.guidance.answer(answer, self.visit_orders.last + 1)
        self._guidance_changed()

    def report_guidance(self) -> GuidanceStatus:
        """The body of ``GET /missions/{id}/guidance``, its orders in words with the user's names."""
        return self.guidance.report(self.mission_id, self.spec.names)

    def end_orders(self, step: int) -> None:
        """End the orders whose end has come, before a decision of this step; a replay has the event of it."""
        if self.guidance.expire(step, max(step, self.visit_orders.last + 1), self.records.confirmed):
            self._guidance_changed()

    def propose_guidance(
        self, guidance: Guidance, model: str | None, doubts: Sequence[str] = (), withdrawn: Sequence[str] = ()
    ) -> None:
        """Propose the guidance that was read in the operator's note."""
        self.guidance.propose(guidance, model, doubts, withdrawn)
        self._guidance_changed()

    def fail_guidance(self, reason: str, model: str | None) -> None:
        """Record that the operator's note was not compiled."""
        self.guidance.fail(reason, model)
        self._guidance_changed()

    def _guidance_changed(self) -> None:
        if self.planner is not None:
            self.planner.follow(self.guidance.confirmed)
        self.record(GuidanceChanged(self.guidance.state_dict()))

    def observe(self, uav: UavState, step: int) -> int:
        """Add a UAV's report to the sensors' records and to the fleet's belief.

        Returns:
            the number of this request among the UAV's at this step, for :meth:`commit`.
        """
        if self.planner is not None:
            self.planner.begin(step)
        self.measured[uav.uav_id] = take_report(uav, step, self.records, self.belief)
        if step > self.readings.began[0]:
            self.readings.began = step, time.monotonic()
        self.record(Reported(step, uav))
        return self.reservations.attempt(step, uav.uav_id)

    def read(self, given: Sequence[SensorReading]) -> list[ReadingResult]:
        """Merge the sensors' own readings into the belief; raises as :meth:`Readings.placed`."""
        placed = self.readings.placed(given)
        results: list[ReadingResult] = ["early"] * len(given)
        if placed is not None:
            results = self.take_readings(placed)
        return results

    def take_readings(self, placed: Sequence[PlacedReading]) -> list[ReadingResult]:
        """Take readings that have their steps; those that change the belief are an event."""
        results = self.readings.take(placed)
        merged = [reading for reading, result in zip(placed, results, strict=True) if result == "merged"]
        if merged:
            self.record(ReadingsMerged(merged))
        return results

    def commit(self, decision: Pending, attempt: int = 1, advice: AdviserReport | None = None) -> None:
        """Reserve the sensor, presume its visit, and wait for the outcome.

        An earlier decision for the same UAV and step is withdrawn: its sensor is free again and counts as not visited.

        Raises:
            Conflict: a later attempt of this UAV at this step already has its answer; nothing is recorded.
        """
        reservation = Reservation(decision.uav_id, decision.sensor_id, decision.decision_id, attempt)
        earlier = self.reservations.reserve(decision.step, reservation)
        forgotten = self.pending.add(decision)
        self.visit_orders.follow(self.guidance.confirmed, decision.step)
        if earlier is not None:
            self.records.withdraw(earlier.sensor_id, earlier.decision_id)
            self.visit_orders.withdraw(earlier.sensor_id, decision.step)
        self.visit_orders.visit(decision.sensor_id, decision.step)
        self.records.presume(decision.sensor_id, decision.decision_id, decision.step)
        for old in forgotten:
            self.records.confirm(old.sensor_id, old.decision_id, old.step)
        self.belief.record_decision(decision.uav_id, decision.step, decision.sensor_id, decision.velocity)
        self.decisions += 1
        if advice is not None:
            self.trust[advice.model].open[decision.decision_id] = advice.advice
        self.record(Decided(decision, attempt, advice))

    def apply(self, outcome: Outcome, *, for_training: bool = True) -> Sample | None:
        """Record the outcome of a pending decision; returns the training sample, if there is one.

        Of several decisions for a UAV at one step only the last one is learned from, so that a UAV that repeats its
        requests has no more influence than the others. A failed transmission is no visit: the visiting record returns
        to the latest visit.
        """
        decision = self.pending.apply(outcome)
        self.feedback += 1
        if outcome.failed:
            self.records.withdraw(decision.sensor_id, decision.decision_id)
            self.visit_orders.withdraw(decision.sensor_id, decision.step)
        else:
            self.records.confirm(decision.sensor_id, decision.decision_id, decision.step)
        self.record(Settled(outcome, for_training))
        last = self.reservations.of(decision.step, decision.uav_id)
        if last is not None and last.decision_id != decision.decision_id:
            return None
        self.belief.settle(decision.uav_id, decision.step, outcome.failed)
        action = Action(decision.sensor_id, decision.velocity)
        line = self.template.experience(decision.seen, action, outcome.cost, outcome.failed)
        self.experiences.remember(Experience(line, decision.sensor_id, outcome.failed))
        for trust in self.trust.values():
            trust.settle(outcome.decision_id, outcome.cost)
        return decision.sample

    def learn(self, sample: Sample, cost: float) -> float | None:
        """Train on one sample; returns the loss before the update, None if the learner fails."""
        try:
            return self.learner.update(sample, cost)
        except Exception:
            log.exception("mission %s: the learner failed on an outcome; decisions go on", self.mission_id)
            return None

    def state_dict(self) -> dict[str, Any]:
        """The state except for the modules and their optimizer, as copies: another thread may serialize it."""
        return {
            "decisions": self.decisions,
            "feedback": self.feedback,
            **{part: getattr(self, part).state_dict() for part in _PARTS},
            "readings": self.readings.state_dict(),
            "applied": self.pending.applied.state_dict(),
            "guidance": self.guidance.state_dict(),
            "trust": {model: trust.state_dict() for model, trust in self.trust.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``; the plan is not part of it and is made again."""
        self.decisions, self.feedback = state["decisions"], state["feedback"]
        for part in _PARTS:
            getattr(self, part).load_state_dict(state[part])
        self.readings.load_state_dict(state["readings"])
        self.pending.applied.load_state_dict(state["applied"])
        for model, trust in state["trust"].items():
            self.trust[model].load_state_dict(trust)
        self.restore_guidance(state["guidance"])

    def restore_guidance(self, state: dict[str, Any]) -> None:
        """Restore the operator's guidance from its ``state_dict``."""
        self.guidance.load_state_dict(state)
        if self.planner is not None:
            self.planner.follow(self.guidance.confirmed)

    @property
    def places(self) -> FloatArray:
        """The sensors' positions, ``(J, 2)``, of a surveyed world before the first report too; NaN: unknown."""
        if self.scenario.layout != "surveyed":
            return self.belief.places
        return np.where(np.isnan(self.belief.places), np.array(self.scenario.sites), self.belief.places)

    def in_ids(self, note: str) -> tuple[str, list[str]]:
        """The note with sensors' IDs for the user's names, and doubts, as :func:`in_ids`."""
        line = self.scenario.pipeline if self.scenario.layout != "uniform" else ()
        return in_ids(note, self.spec.names, self.spec.map or (), self.places, line)

    def deadlines(self) -> list[VisitDeadline]:
        """The deadlines of the operator's visit orders, met and missed, in the completed steps."""
        last = self.visit_orders.last
        return self.visit_orders.counts(last - 1 if self.pending.waits_for(last) else last)
