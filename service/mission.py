"""One fleet's state: visiting records, arrival rates, reservations, experiences, pending decisions, learner."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from service.candidates import GuidedTemplate
from service.checkpoint import initial_modules
from service.demonstrations import solved
from service.experiences import NEAREST, Experience, Experiences
from service.features import filled
from service.guidance import OperatorGuidance
from service.learner import Learner, Modules, Sample
from service.planner import Planner, can_plan
from service.problems import Conflict, NotFound, Refused
from service.prompt import Template, note_block
from service.rows import Cells
from service.settings import Settings, prompt_tokens
from service.trust import Trust
from shared.channel import FloatArray
from shared.fleetplan import FleetBelief
from shared.guidance import GuidanceAnswer
from shared.scenario import Scenario, scenario_named
from shared.wire import Belief, Features, MissionSpec, MissionStatus, Mode, Outcome, UavState

# An outcome comes with the UAV's next request, so a few steps of a fleet are plenty; what is older is forgotten.
_PENDING_PER_UAV = 8
_APPLIED_PER_UAV = 64
# UAVs of one fleet may be this many steps apart.
_RESERVED_STEPS = 64
# Weight, in steps, of the scenario's mean arrival rate against what is observed.
_PRIOR_STEPS = 2.0
_NEVER = -1


@dataclass(frozen=True, slots=True)
class Pending:
    """A decision whose outcome is still to come.

    ``seen`` is the sensor's row as it was then; ``sample`` is None where the modules had no part in the decision.
    """

    decision_id: str
    uav_id: int
    step: int
    sensor_id: int
    velocity: int
    seen: Cells
    sample: Sample | None


@dataclass(frozen=True, slots=True)
class Given:
    """The sensor that a UAV was given at a step, and by which of its attempts."""

    sensor_id: int
    decision_id: str
    attempt: int


class Mission:
    """One fleet's state. Only the event loop touches it, apart from the learner's own thread.

    Raises:
        Refused: the spec names an unknown scenario, or its prompt cannot fit the LLM's context.
    """

    def __init__(self, mission_id: str, spec: MissionSpec, settings: Settings) -> None:
        try:
            named = spec.scenario
            self.scenario: Scenario = scenario_named(named) if isinstance(named, str) else named
        except ValueError as error:
            raise Refused("scenario", str(error)) from None
        self.mission_id = mission_id
        self.mode: Mode = spec.mode or settings.mode
        # The paper's method as it is written, unless asked otherwise.
        written = self.mode == "llm"
        self.features: Features = spec.features or ("paper" if written else "reach")
        self.decides_from: Belief = spec.belief or ("reported" if written else "fleet")
        self.spec = spec
        self.top_k = spec.top_k or settings.top_k
        told = spec.prompt.experiences
        self._experience_limit = settings.experiences if told is None else told
        self._selection = spec.prompt.selection or settings.selection
        # Mode `value` has nothing else to decide by.
        self.attends = spec.attention == "on" or self.mode == "value"
        modules = initial_modules(spec.init, self.features, self.scenario.max_velocity + 1, spec.seed)
        self.template = self._template(modules)
        self._context = settings.llm_context
        self._check_prompt()
        self.memory = Experiences(self._experience_limit, self._selection, self.scenario.uavs)
        self.decisions = 0
        self.feedback = 0
        self.learner = Learner(modules, learning_rate=settings.learning_rate)
        sensors = self.scenario.sensors
        self.visits = np.full(sensors, _NEVER, dtype=np.int64)
        self._confirmed = np.full(sensors, _NEVER, dtype=np.int64)
        self._open_visits: dict[int, dict[str, int]] = {}
        self._seen = np.full(sensors, _NEVER, dtype=np.int64)
        self._queue = np.zeros(sensors)
        self._arrivals = np.full(sensors, self.scenario.mean_arrival_rate * _PRIOR_STEPS)
        self._exposure = np.full(sensors, _PRIOR_STEPS)
        self._given: dict[int, dict[int, Given]] = {}
        self._attempts: dict[int, dict[int, int]] = {}
        self._pending: dict[str, Pending] = {}
        self._applied: OrderedDict[str, None] = OrderedDict()
        self.belief = FleetBelief(self.scenario)
        wanted = (spec.planner or settings.planner) == "on"
        self.planner = Planner(self.scenario, self.belief) if wanted and can_plan(self.scenario) else None
        self.guidance = OperatorGuidance(spec.note, self.scenario)
        # Mode `guided`: by the LLM's name.
        self.trust: dict[str, Trust] = {}

    def _template(self, modules: Modules) -> Template:
        spec = self.spec
        said: dict[str, Any] = {
            "experiences": self._experience_limit,
            "ranked": self.attends and spec.prompt.order == "score",
            "note": spec.note,
        }
        if self.mode == "guided":
            return GuidedTemplate(self.scenario, rows=self.top_k if self.attends else self.scenario.sensors, **said)
        kept = self.top_k if self.attends else None
        examples = solved(spec, self.features, self.scenario, modules, kept)
        return Template(self.scenario, spec.prompt, self.features, demonstrations=examples, **said)

    def obey(self, answer: GuidanceAnswer) -> None:
        """The operator's word on the guidance; raises as :meth:`OperatorGuidance.answer`."""
        self.guidance.answer(answer)
        if self.planner is not None:
            self.planner.obey(self.guidance.obeyed)

    @property
    def asks(self) -> bool:
        """Whether an LLM has a part in the decisions."""
        return self.mode in ("llm", "guided")

    @property
    def experiences(self) -> list[str]:
        """Lines of the prompt's block of experiences."""
        return self.memory.block

    @property
    def most_cost(self) -> float:
        """More than any step can cost: Eq. 5 counts a failure a UAV and an overflow a sensor at most."""
        return float(self.scenario.uavs + self.scenario.sensors)

    @property
    def rates(self) -> FloatArray:
        """Observed arrival rates lambda_hat, packets a step, shape ``(J,)``."""
        rates: FloatArray = self._arrivals / self._exposure
        return rates

    def check(self, uav: UavState, step: int, at: str = "") -> None:
        """Refuse, before anything is recorded, what this mission's world does not have.

        Args:
            at: where in the request's body this UAV stands, such as ``uavs[1].``.

        Raises:
            Refused: an unknown UAV or sensor, a queue past its capacity, a beacon later than the step, or an outcome of
                another UAV's decision.
            NotFound: an outcome of a decision that this mission does not know.
        """
        if uav.uav_id >= self.scenario.uavs:
            raise Refused(f"{at}uav_id", f"UAV {uav.uav_id} is unknown: this mission has {self.scenario.uavs}, from 0")
        if (highest := max(uav.sensors.id)) >= self.scenario.sensors:
            raise Refused(f"{at}sensors.id", f"sensor {highest} is unknown: there are {self.scenario.sensors}, from 0")
        fullest = max((q for q in uav.sensors.queue if q is not None), default=0.0)
        if fullest > self.scenario.queue_capacity:
            limit = self.scenario.queue_capacity
            raise Refused(f"{at}sensors.queue", f"{fullest:g} packets exceed the capacity of {limit}")
        if (latest := max((s for s in uav.sensors.last_seen if s is not None), default=0)) > step:
            raise Refused(f"{at}sensors.last_seen", f"step {latest} is later than this step {step}")
        if uav.outcome is not None:
            name = uav.outcome.decision_id
            self.find(name, f"{at}outcome.decision_id")
            if name in self._pending and (whose := self._pending[name].uav_id) != uav.uav_id:
                raise Refused(
                    f"{at}outcome.decision_id", f"decision {name} is UAV {whose}'s, who alone knows its outcome"
                )

    def holds(self, uavs: int) -> bool:
        """Whether the LLM's context is large enough for a prompt about so many UAVs at once."""
        return self._prompt_needs(uavs) <= self._context

    def _prompt_needs(self, uavs: int = 1) -> int:
        """Tokens that a prompt may take at most."""
        lines = self._experience_limit + (NEAREST if self._selection == "similar" else 0)
        style, rows = self.spec.prompt, self._rows * uavs
        needed = prompt_tokens(style.format, rows, lines, self.features, self.template.demonstrations)
        # No tokenizer makes more tokens than bytes.
        return needed + len(note_block(self.spec.note).encode())

    @property
    def _rows(self) -> int:
        return min(self.scenario.sensors, self.top_k) if self.attends else self.scenario.sensors

    def _check_prompt(self) -> None:
        """Refuse a prompt that the LLM's context cannot hold; without an LLM nobody reads it."""
        style = self.spec.prompt
        if self.asks and not self.holds(1):
            shown = f"{self._experience_limit} experiences"
            lower = "prompt.experiences"
            if style.demonstrations:
                shown += f", {style.demonstrations} demonstrations"
                lower += ", prompt.demonstrations"
            raise Refused(
                "prompt",
                f"{shown} and {self._rows} sensors as {style.format} need up to {self._prompt_needs()} tokens "
                f"and AICVDS_LLM_CONTEXT is {self._context}: raise it, or lower {lower} or top_k",
            )

    def find(self, decision_id: str, field: str = "decision_id") -> Literal["pending", "applied"]:
        """Where a decision stands; raises :class:`NotFound` for one that this mission does not know."""
        if decision_id in self._pending:
            return "pending"
        if decision_id in self._applied:
            return "applied"
        raise NotFound(field, f"mission {self.mission_id} knows no decision {decision_id} (or no longer)")

    def observe(self, uav: UavState, step: int) -> None:
        """Take a UAV's report: arrival rates from the beacons that are news, and all of it into the fleet's belief.

        Between two beacons of one sensor, with no visit and no overflow between them, its queue grew by the arrivals.
        """
        ids = np.asarray(uav.sensors.id)
        seen = filled(uav.sensors.last_seen, _NEVER).astype(np.int64)
        queue = filled(uav.sensors.queue)
        if self.planner is not None:
            self.planner.begin(step)
        self.belief.advance(step)
        self.belief.locate(uav.uav_id, step, uav.position, uav.progress_m)
        places = np.stack((uav.sensors.x, uav.sensors.y), axis=1)
        self.belief.hear(ids, places, seen, queue, filled(uav.sensors.battery))
        news = seen > self._seen[ids]
        undisturbed = (self._seen[ids] >= 0) & (self.visits[ids] < self._seen[ids])
        usable = news & undisturbed & (queue < self.scenario.queue_capacity) & (queue >= self._queue[ids])
        self._arrivals[ids[usable]] += (queue - self._queue[ids])[usable]
        self._exposure[ids[usable]] += (seen - self._seen[ids])[usable]
        self._seen[ids[news]] = seen[news]
        self._queue[ids[news]] = queue[news]

    def reserved(self, step: int, uav_id: int) -> frozenset[int]:
        """Sensors that other UAVs were given this step."""
        return frozenset(given.sensor_id for uav, given in self._given.get(step, {}).items() if uav != uav_id)

    def attempt(self, step: int, uav_id: int) -> int:
        """Number a request of a UAV at a step: when it asks again, the later answer counts."""
        attempts = self._attempts.setdefault(step, {})
        attempts[uav_id] = attempts.get(uav_id, 0) + 1
        _forget_lowest(self._attempts)
        return attempts[uav_id]

    def commit(self, decision: Pending, attempt: int = 1) -> None:
        """Reserve the sensor, note the visit, and wait for the outcome.

        An earlier decision for the same UAV and step is withdrawn: its sensor is free again and was not visited.

        Raises:
            Conflict: a later attempt of this UAV at this step was answered already; nothing is recorded.
        """
        given = self._given.setdefault(decision.step, {})
        earlier = given.get(decision.uav_id)
        if earlier is not None and earlier.attempt > attempt:
            raise Conflict("step", f"UAV {decision.uav_id} asked again for step {decision.step} and was answered")
        if earlier is not None:
            self._close_visit(earlier.sensor_id, earlier.decision_id)
        given[decision.uav_id] = Given(decision.sensor_id, decision.decision_id, attempt)
        _forget_lowest(self._given)
        self._open_visits.setdefault(decision.sensor_id, {})[decision.decision_id] = decision.step
        self._update_visit(decision.sensor_id)
        self._pending[decision.decision_id] = decision
        self.belief.tell(decision.uav_id, decision.step, decision.sensor_id, decision.velocity)
        own = [d for d in self._pending.values() if d.uav_id == decision.uav_id]
        for forgotten in own[:-_PENDING_PER_UAV]:
            del self._pending[forgotten.decision_id]
            self._confirm_visit(forgotten)
        self.decisions += 1

    def apply(self, outcome: Outcome) -> Sample | None:
        """Record the outcome of a pending decision; returns what the modules saw, to learn from.

        A failed transmission was no visit: the visiting record goes back to the latest visit that was one.
        """
        decision = self._pending.pop(outcome.decision_id)
        self._applied[decision.decision_id] = None
        while len(self._applied) > _APPLIED_PER_UAV * self.scenario.uavs:
            self._applied.popitem(last=False)
        self.feedback += 1
        if outcome.failed:
            self._close_visit(decision.sensor_id, decision.decision_id)
        else:
            self._confirm_visit(decision)
        line = self.template.experience(decision.seen, decision.sensor_id, decision.velocity, outcome.cost)
        sample = decision.sample
        features = None if sample is None else sample.features[sample.chosen].copy()
        self.memory.remember(Experience(line, outcome.cost, features))
        return sample

    def _confirm_visit(self, decision: Pending) -> None:
        self._confirmed[decision.sensor_id] = max(self._confirmed[decision.sensor_id], decision.step)
        self._close_visit(decision.sensor_id, decision.decision_id)

    def _close_visit(self, sensor_id: int, decision_id: str) -> None:
        self._open_visits.get(sensor_id, {}).pop(decision_id, None)
        self._update_visit(sensor_id)

    def _update_visit(self, sensor_id: int) -> None:
        """TVR_j: the latest step of a visit that is confirmed, or still open and so presumed to succeed."""
        presumed = max(self._open_visits.get(sensor_id, {}).values(), default=_NEVER)
        self.visits[sensor_id] = max(int(self._confirmed[sensor_id]), presumed)

    def status(self) -> MissionStatus:
        """What ``GET /missions/{id}`` says."""
        return MissionStatus(
            mission_id=self.mission_id,
            scenario=self.scenario,
            mode=self.mode,
            top_k=self.top_k,
            attention=self.spec.attention,
            features=self.features,
            belief=self.decides_from,
            planner="off" if self.planner is None else "on",
            prompt=self.spec.prompt.model_copy(
                update={"experiences": self._experience_limit, "selection": self._selection}
            ),
            init=self.spec.init,
            seed=self.spec.seed,
            decisions=self.decisions,
            feedback=self.feedback,
            experiences=len(self.experiences),
            learner_updates=self.learner.updates,
            learner_loss=self.learner.last_loss,
            visits={int(s): int(self.visits[s]) for s in np.flatnonzero(self.visits >= 0)},
        )


def _forget_lowest(by_step: dict[int, Any]) -> None:
    while len(by_step) > _RESERVED_STEPS:
        del by_step[min(by_step)]
