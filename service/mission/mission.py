"""One fleet's state: visiting records, arrival rates, reservations, experiences, pending decisions, learner."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from service.config.prompt_budget import prompt_tokens
from service.config.settings import Settings
from service.errors import Conflict, NotFound, Refused
from service.guidance.operator_guidance import OperatorGuidance
from service.learning.initial_weights import initial_weights
from service.learning.learner import Learner
from service.learning.modules import Sample, Weights
from service.learning.trust import PRIOR, PRIOR_UNPLANNED, Trust
from service.mission.applied_outcomes import AppliedOutcomes
from service.mission.delta_reports import AnyReport, DeltaBases
from service.mission.events import AdviserReport, Decided, Event, Guided, Pending, Reported, Settled, unheard
from service.mission.idempotency import IdempotentAnswers
from service.mission.planner import Planner, can_plan
from service.mission.reservations import STEPS_APART, Reservation, Reservations
from service.mission.resolved_spec import ResolvedSpec
from service.prompting.demonstrations import solved
from service.prompting.experiences import NEAREST, Experience, Experiences
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.prompt import Template, note_block
from shared.channel import FloatArray
from shared.fleetplan import FleetBelief
from shared.guidance import Guidance, GuidanceAnswer
from shared.missions import MissionStatus
from shared.records import Records, take_report
from shared.scenario import Scenario, scenario_named
from shared.wire import Belief, Features, MissionSpec, Mode, Outcome, Selection, UavState

log = logging.getLogger(__name__)

# An outcome comes with the UAV's next request, so a few steps of a fleet are plenty; what is older is forgotten.
_PENDING_PER_UAV = 8
_APPLIED_PER_UAV = 64


class Mission:
    """One fleet's state. Only the event loop touches it.

    Everything that changes it is an event, which ``record`` hears of: the same events in the same order, on the same
    spec, make the same mission again (see :mod:`service.storage.recovery`).

    Attributes:
        asked_for: the spec as it was given; ``spec`` says in full what the service's settings made of it.
        promptable: whether the LLM's context holds its prompt, whatever it comes to say; True where none is asked.

    Args:
        spec: of a mission that has flown already: it flies on whatever the settings are now.

    Raises:
        Refused: the spec names an unknown scenario, or its prompt cannot fit the LLM's context.
    """

    def __init__(
        self, mission_id: str, asked_for: MissionSpec, settings: Settings, spec: ResolvedSpec | None = None
    ) -> None:
        self.mission_id = mission_id
        self.asked_for = asked_for
        flown, spec = spec is not None, spec or ResolvedSpec.of(asked_for, settings)
        self.spec = spec
        try:
            named = spec.scenario
            self.scenario: Scenario = scenario_named(named) if isinstance(named, str) else named
        except ValueError as error:
            raise Refused("scenario", str(error)) from None
        self.mode: Mode = spec.mode
        self.features: Features = spec.features
        self.decides_from: Belief = spec.belief
        self.top_k = spec.top_k
        self._experience_limit = spec.prompt.experiences
        self._selection: Selection = spec.prompt.selection
        # Mode `value` has nothing else to decide by.
        self.attends = spec.attention == "on" or self.mode == "value"
        weights = initial_weights(spec.init, self.features, self.scenario.max_velocity + 1, spec.seed)
        self.template = self._template(weights)
        self._context = settings.llm_context
        self.promptable = not self.asks or self.holds(1)
        if not flown:
            self._check_prompt()
        self.memory = Experiences(self._experience_limit, self._selection, self.scenario.uavs)
        self.decisions = 0
        self.feedback = 0
        self.learner = Learner(weights, learning_rate=settings.learning_rate)
        self.records = Records(self.scenario)
        self.turns = Reservations()
        self._pending: dict[str, Pending] = {}
        self._applied = AppliedOutcomes(_APPLIED_PER_UAV * self.scenario.uavs)
        self.repeats = IdempotentAnswers(_PENDING_PER_UAV * self.scenario.uavs)
        self.belief = FleetBelief(self.scenario)
        self.bases = DeltaBases()
        wanted = spec.planner == "on"
        self.planner = Planner(self.scenario, self.belief) if wanted and can_plan(self.scenario) else None
        self.guidance = OperatorGuidance(spec.note, self.scenario)
        # Mode `guided`: by the LLM's name.
        self.trust: dict[str, Trust] = {}
        self.record: Callable[[Event], None] = unheard

    def _template(self, weights: Weights) -> Template:
        spec = self.spec
        said: dict[str, Any] = {
            "experiences": self._experience_limit,
            "ranked": self.attends and spec.prompt.order == "score",
            "note": spec.note,
        }
        if self.mode == "guided":
            return GuidedTemplate(self.scenario, rows=self.top_k if self.attends else self.scenario.sensors, **said)
        kept = self.top_k if self.attends else None
        examples = solved(spec, self.features, self.scenario, weights, kept)
        return Template(self.scenario, spec.prompt, self.features, demonstrations=examples, **said)

    def obey(self, answer: GuidanceAnswer) -> None:
        """The operator's word on the guidance; raises as :meth:`OperatorGuidance.answer`."""
        self.guidance.answer(answer)
        self._heed()

    def understand(self, guidance: Guidance, model: str | None) -> None:
        """An LLM made this of the operator's note."""
        self.guidance.propose(guidance, model)
        self._heed()

    def misunderstand(self, why: str, model: str | None) -> None:
        """Nothing could be made of the operator's note."""
        self.guidance.fail(why, model)
        self._heed()

    def _heed(self) -> None:
        if self.planner is not None:
            self.planner.obey(self.guidance.obeyed)
        self.record(Guided(self.guidance.state_dict()))

    def trust_in(self, model: str | None) -> Trust:
        """Mode ``guided``: the trust in the advisers while this LLM is one of them."""
        name = model or ""
        if name not in self.trust:
            prior = PRIOR if self.planner is not None else PRIOR_UNPLANNED
            self.trust[name] = Trust(prior, most_open=_PENDING_PER_UAV * self.scenario.uavs)
        return self.trust[name]

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
    def visits(self) -> NDArray[np.int64]:
        """TVR_j: each sensor's last visit, a step, shape ``(J,)``; -1 for never."""
        return self.records.visits

    @property
    def rates(self) -> FloatArray:
        """Observed arrival rates lambda_hat, packets a step, shape ``(J,)``."""
        return self.records.rates

    def completed(self, uav: AnyReport, step: int, at: str = "") -> AnyReport:
        """A UAV's report in full. What this mission's world does not have is refused, before anything is recorded.

        Args:
            at: where in the request's body this UAV stands, such as ``uavs[1].``.

        Raises:
            Refused: a step far past the newest one, an unknown UAV or sensor, a queue past its capacity, a beacon later
                than the step, an outcome of another UAV's decision, or as :meth:`DeltaBases.complete`.
            Incomplete: the report leaves out what is not held.
            NotFound: an outcome of a decision that this mission does not know.
        """
        self._must_be_near(step)
        if uav.uav_id >= self.scenario.uavs:
            raise Refused(f"{at}uav_id", f"UAV {uav.uav_id} is unknown: this mission has {self.scenario.uavs}, from 0")
        if (highest := max(uav.sensors.id, default=0)) >= self.scenario.sensors:
            raise Refused(f"{at}sensors.id", f"sensor {highest} is unknown: there are {self.scenario.sensors}, from 0")
        uav = self.bases.complete(uav, step, self.belief.places, at)
        fullest = max((q for q in uav.sensors.queue if q is not None), default=0.0)
        if fullest > self.scenario.queue_capacity:
            limit = self.scenario.queue_capacity
            raise Refused(f"{at}sensors.queue", f"{fullest:g} packets exceed the capacity of {limit}")
        if (latest := max((s for s in uav.sensors.last_seen if s is not None), default=0)) > step:
            raise Refused(f"{at}sensors.last_seen", f"step {latest} is later than this step {step}")
        if uav.outcome is not None:
            name = uav.outcome.decision_id
            self._must_know(name, f"{at}outcome.")
            if name in self._pending and (whose := self._pending[name].uav_id) != uav.uav_id:
                raise Refused(
                    f"{at}outcome.decision_id", f"decision {name} is UAV {whose}'s, who alone knows its outcome"
                )
        return uav

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
        if not self.promptable:
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

    def find(self, outcome: Outcome) -> Literal["pending", "applied"]:
        """Whether an outcome is yet to be applied, or was.

        Raises:
            NotFound: this mission does not know the decision.
            Conflict: it was told another outcome of it before, which counts.
        """
        name = outcome.decision_id
        self._must_know(name)
        if name in self._pending:
            return "pending"
        cost, failed = self._applied[name]
        if (min(outcome.cost, self.most_cost), outcome.failed) != (cost, failed):
            told = f"cost {cost:g}{', failed' if failed else ''}"
            raise Conflict("cost", f"of decision {name} another outcome was told before, which counts: {told}")
        return "applied"

    def _must_be_near(self, step: int) -> None:
        """Refuse a report from the future: what it tells is the newest there is, and what is true would be too old.

        A fleet may be out of contact for as long as its scenario lasts. The first report may be of any step: an edge
        that lost its missions hears of them in their midst, and fleets fly on past their scenario's last step.
        """
        newest, ahead = self.belief.newest, max(STEPS_APART, self.scenario.steps)
        if newest is not None and step > newest + ahead:
            raise Refused(
                "step",
                f"step {step} is more than {ahead} past {newest}, the newest step known of mission {self.mission_id}: "
                "DELETE the mission if its fleet was away so long",
            )

    def _must_know(self, decision_id: str, at: str = "") -> None:
        if decision_id not in self._pending and decision_id not in self._applied:
            told = f"mission {self.mission_id} knows no decision {decision_id} (or no longer)"
            raise NotFound(f"{at}decision_id", told)

    def observe(self, uav: UavState, step: int) -> int:
        """Take a UAV's report: into the sensors' records, and all of it into the fleet's belief.

        Returns the number of this request among the UAV's at this step, for :meth:`commit`.
        """
        if self.planner is not None:
            self.planner.begin(step)
        take_report(uav, step, self.records, self.belief)
        self.record(Reported(step, uav))
        return self.turns.attempt(step, uav.uav_id)

    def reserved(self, step: int, uav_id: int) -> frozenset[int]:
        """Sensors that other UAVs were given this step."""
        return self.turns.reserved(step, uav_id)

    def commit(self, decision: Pending, attempt: int = 1, counsel: AdviserReport | None = None) -> None:
        """Reserve the sensor, note the visit, and wait for the outcome.

        An earlier decision for the same UAV and step is withdrawn: its sensor is free again and was not visited.

        Raises:
            Conflict: a later attempt of this UAV at this step was answered already; nothing is recorded.
        """
        earlier = self.turns.given(decision.step, decision.uav_id)
        if earlier is not None and earlier.attempt > attempt:
            raise Conflict("step", f"UAV {decision.uav_id} asked again for step {decision.step} and was answered")
        if earlier is not None:
            self.records.withdraw(earlier.sensor_id, earlier.decision_id)
        given = Reservation(decision.uav_id, decision.sensor_id, decision.decision_id, attempt)
        self.turns.give(decision.step, given)
        self.records.presume(decision.sensor_id, decision.decision_id, decision.step)
        self._pending[decision.decision_id] = decision
        self.belief.tell(decision.uav_id, decision.step, decision.sensor_id, decision.velocity)
        own = [d for d in self._pending.values() if d.uav_id == decision.uav_id]
        for forgotten in own[:-_PENDING_PER_UAV]:
            del self._pending[forgotten.decision_id]
            self.records.confirm(forgotten.sensor_id, forgotten.decision_id, forgotten.step)
        self.decisions += 1
        if counsel is not None:
            self.trust_in(counsel.model).note(decision.decision_id, counsel.advice)
        self.record(Decided(decision, attempt, counsel))

    def apply(self, outcome: Outcome, *, taught: bool = True) -> Sample | None:
        """Record the outcome of a pending decision; returns what the modules saw, to learn from.

        Of a UAV that asked more than once at a step only the decision that stands teaches anything: one that asks
        again and again has no more say than the others. A failed transmission was no visit: the visiting record goes
        back to the latest visit that was one.
        """
        decision = self._pending.pop(outcome.decision_id)
        self._applied.add(decision.decision_id, outcome.cost, outcome.failed)
        self.feedback += 1
        if outcome.failed:
            self.records.withdraw(decision.sensor_id, decision.decision_id)
        else:
            self.records.confirm(decision.sensor_id, decision.decision_id, decision.step)
        self.record(Settled(outcome, taught))
        standing = self.turns.given(decision.step, decision.uav_id)
        if standing is not None and standing.decision_id != decision.decision_id:
            return None
        line = self.template.experience(decision.seen, decision.sensor_id, decision.velocity, outcome.cost)
        sample = decision.sample
        features = None if sample is None else sample.features[sample.chosen].copy()
        self.memory.remember(Experience(line, outcome.cost, features))
        for trust in self.trust.values():
            trust.settle(outcome.decision_id, outcome.cost)
        return sample

    def learn(self, sample: Sample, cost: float) -> float | None:
        """One lesson, and the loss before it; one that fails is told and left out: None."""
        try:
            return self.learner.update(sample, cost)
        except Exception:
            log.exception("mission %s: the learner failed on an outcome; decisions go on", self.mission_id)
            return None

    def state_dict(self) -> dict[str, Any]:
        """All of it but the modules and their optimizer, as copies: another thread may write it down."""
        return {
            "decisions": self.decisions,
            "feedback": self.feedback,
            "pending": [decision.state_dict() for decision in self._pending.values()],
            "applied": self._applied.state_dict(),
            "repeats": self.repeats.state_dict(),
            "memory": self.memory.state_dict(),
            "records": self.records.state_dict(),
            "turns": self.turns.state_dict(),
            "belief": self.belief.state_dict(),
            "guidance": self.guidance.state_dict(),
            "trust": {model: trust.state_dict() for model, trust in self.trust.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken, but for the plan, which is made again."""
        self.decisions, self.feedback = state["decisions"], state["feedback"]
        self._pending = {told["decision_id"]: Pending.of(told) for told in state["pending"]}
        self._applied.load_state_dict(state["applied"])
        self.repeats.load_state_dict(state["repeats"])
        self.memory.load_state_dict(state["memory"])
        self.records.load_state_dict(state["records"])
        self.turns.load_state_dict(state["turns"])
        self.belief.load_state_dict(state["belief"])
        for model, trust in state["trust"].items():
            self.trust_in(model).load_state_dict(trust)
        self.reinstate(state["guidance"])

    def reinstate(self, guidance: dict[str, Any]) -> None:
        """The operator's guidance as it stood."""
        self.guidance.load_state_dict(guidance)
        if self.planner is not None:
            self.planner.obey(self.guidance.obeyed)

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
            verify=self.spec.verify,
            prompt=self.spec.prompt,
            init=self.spec.init,
            seed=self.spec.seed,
            decisions=self.decisions,
            feedback=self.feedback,
            experiences=len(self.experiences),
            learner_updates=self.learner.updates,
            learner_loss=self.learner.last_loss,
            visits={int(s): int(self.visits[s]) for s in np.flatnonzero(self.visits >= 0)},
        )
