"""The prompts of each decision of a mission, in several forms.

A policy on board flies the mission. Each form of the prompt has a mission object of the edge, which gets the UAVs'
reports, the decisions and their costs, and makes its prompts. So all prompts of one decision are about the same
situation, and no LLM is needed.
"""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from typing import Any

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import candidates_of, template_of
from service.deciding.rollout_state import RolloutState
from service.llm.request_bodies import chat_body, label_body
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.prompt import Prompt
from shared.wire.schemas import MissionSpec, Outcome
from shared.world.scenario import Scenario
from shared.world.step_rule import Action
from simulator.flying.flight import fly
from simulator.flying.pilots import LocalPilot, PilotChoice
from simulator.sites.site import Site
from simulator.world.observation import Observation, decide_request

GUIDED, LLM, PAPER = "guided", "llm", "paper"
FORMS = {
    GUIDED: "mode guided (default)",
    LLM: "mode llm: the paper's template",
    PAPER: "the same without attention",
}
_POLICY = "mpc"
# Enough for the longest prompt, the paper's without attention.
CONTEXT = 8192


@dataclass(frozen=True)
class DecisionPrompt:
    """The prompt of one decision in one form; ``offer`` has the lettered candidates of mode ``guided``."""

    prompt: Prompt
    sensors: list[int]
    offer: CandidateSet | None = None

    def body(self, velocities: int) -> dict[str, Any]:
        """The request to the embedded LLM, as the edge would send it."""
        static, user = self.prompt.static, self.prompt.user
        if self.offer is not None:
            return label_body(None, static, user, "grammar", [list(self.offer.labels)])
        return chat_body(None, static, user, "grammar", self.sensors, velocities)


@dataclass(frozen=True)
class FlownDecision:
    """One decision: its prompts by form, and the situation in which the rollout evaluator judges answers."""

    seed: int
    step: int
    uav: int
    prompts: dict[str, DecisionPrompt]
    situation: RolloutState


@dataclass(frozen=True)
class FleetPrompt:
    """Mode ``guided``'s query about all UAVs of one step."""

    step: int
    prompt: Prompt
    lists: list[list[str]]

    def body(self) -> dict[str, Any]:
        """The request to the embedded LLM, as the edge would send it."""
        return label_body(None, self.prompt.static, self.prompt.user, "grammar", self.lists)


class RecordingPilot(LocalPilot):
    """Flies by a planner on board and records the prompts of each decision.

    ``decisions`` are those for which every form has a prompt. ``fleet_prompts`` are those of the steps in which every
    UAV has one.
    """

    def __init__(self, scenario: Scenario, seed: int, policy: str = _POLICY) -> None:
        super().__init__(policy, scenario, seed)
        self._seed = seed
        self._missions = missions(scenario, seed)
        self._outcomes: dict[int, Outcome] = {}
        self._decided: dict[int, str] = {}
        self._step: dict[int, tuple[CandidateSet, AttendedState]] = {}
        self.decisions: list[FlownDecision] = []
        self.fleet_prompts: list[FleetPrompt] = []

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The policy's choice."""
        choice = super().decide(uav, observation, taken)
        step = int(observation["step"][0])
        self._decided[uav] = name = uuid.uuid4().hex
        request = decide_request(uav, observation, "flown", outcome=self._outcomes.pop(uav, None))
        prompts: dict[str, DecisionPrompt] = {}
        situation: RolloutState | None = None
        for form, mission in self._missions.items():
            if request.outcome is not None:
                mission.apply(request.outcome)
            attempt = mission.observe(request, step)
            view = AttendedState.of(mission, request, step)
            if view.rows:
                prompts[form] = self._prompt_of(mission, view)
            if form == GUIDED:
                reserved = mission.reservations.of_others(step, uav)
                situation = RolloutState.of(mission.belief, mission.scenario, step, uav, reserved=reserved)
            mission.commit(view.pending(name, Action(choice.sensor, choice.velocity)), attempt)
        if situation is not None and len(prompts) == len(self._missions):
            self.decisions.append(FlownDecision(self._seed, step, uav, prompts, situation))
        return choice

    def _prompt_of(self, mission: Mission, view: AttendedState) -> DecisionPrompt:
        shown = view.shown()
        if not isinstance(mission.template, GuidedTemplate):
            return DecisionPrompt(mission.template.prompt(view.state, shown, mission.experiences.block), view.kept_ids)
        offer = candidates_of(view, template_of(mission))
        self._record(mission, mission.template, view, offer)
        prompt = mission.template.choice_prompt(offer, view.state, mission.experiences.block)
        return DecisionPrompt(prompt, view.kept_ids, offer)

    def _record(self, mission: Mission, template: GuidedTemplate, view: AttendedState, offer: CandidateSet) -> None:
        self._step = {uav: prompted for uav, prompted in self._step.items() if prompted[1].step == view.step}
        self._step[view.uav_id] = offer, view
        if len(self._step) == mission.scenario.uavs:
            shares = template.fleet_prompts(
                {u: (o, v.state) for u, (o, v) in self._step.items()}, mission.experiences.block
            )
            first = next(iter(shares.values()))
            state = "".join(share.state for share in shares.values())
            whole = Prompt(template.fleet_static, first.experiences, state, first.uncompressed)
            lists = [list(o.labels) for o, _ in self._step.values()]
            self.fleet_prompts.append(FleetPrompt(view.step, whole, lists))

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        """Keep the outcome for this UAV's next request."""
        self._outcomes[uav] = Outcome(decision_id=self._decided[uav], cost=cost, failed=failed)


def missions(scenario: Scenario, seed: int) -> dict[str, Mission]:
    """The edge's mission for each of ``FORMS``, with the default settings."""
    settings = Settings(llm_context=CONTEXT, llm_adapter="off")

    def create(name: str, **spec: Any) -> Mission:
        return Mission(name, MissionSpec(scenario=scenario, seed=seed, planner="off", **spec), settings)

    return {
        GUIDED: create(GUIDED, mode="guided"),
        LLM: create(LLM, mode="llm"),
        PAPER: create(PAPER, mode="llm", attention="off"),
    }


def flown(scenario: Scenario, seed: int, policy: str = _POLICY) -> RecordingPilot:
    """Fly and record one mission."""
    pilot = RecordingPilot(scenario, seed, policy)
    fly(Site(scenario), pilot, seed)
    return pilot
