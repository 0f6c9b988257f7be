"""The prompts of a mission, decision by decision, in several forms side by side.

A policy on board flies the mission. For each form of the prompt there is one of the edge's missions: it gets the UAVs'
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
WAYS = {
    GUIDED: "mode guided (default)",
    LLM: "mode llm: the paper's template",
    PAPER: "the same without attention",
}
_POLICY = "mpc"
# Enough for the longest prompt, the paper's without attention.
CONTEXT = 8192


@dataclass(frozen=True)
class Put:
    """One decision's prompt in one form; mode ``guided``, whose answer is a letter, has an ``offer``."""

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
class Asked:
    """One decision: its prompts by form, and the situation for the rollout evaluator to judge answers."""

    seed: int
    step: int
    uav: int
    ways: dict[str, Put]
    situation: RolloutState


@dataclass(frozen=True)
class Together:
    """One step of the fleet as mode ``guided``'s query about all UAVs."""

    step: int
    prompt: Prompt
    lists: list[list[str]]

    def body(self) -> dict[str, Any]:
        """The request to the embedded LLM, as the edge would send it."""
        return label_body(None, self.prompt.static, self.prompt.user, "grammar", self.lists)


class Scribe(LocalPilot):
    """Flies by a planner on board and records the prompts of each decision.

    ``asked`` has the decisions for which every form has a prompt, ``together`` the fleet's whole steps.
    """

    def __init__(self, scenario: Scenario, seed: int, policy: str = _POLICY) -> None:
        super().__init__(policy, scenario, seed)
        self._seed = seed
        self._missions = missions(scenario, seed)
        self._owed: dict[int, Outcome] = {}
        self._decided: dict[int, str] = {}
        self._step: dict[int, tuple[CandidateSet, AttendedState]] = {}
        self.asked: list[Asked] = []
        self.together: list[Together] = []

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The policy's choice."""
        choice = super().decide(uav, observation, taken)
        step = int(observation["step"][0])
        self._decided[uav] = name = uuid.uuid4().hex
        request = decide_request(uav, observation, "flown", outcome=self._owed.pop(uav, None))
        ways: dict[str, Put] = {}
        situation: RolloutState | None = None
        for way, mission in self._missions.items():
            if request.outcome is not None:
                mission.apply(request.outcome)
            attempt = mission.observe(request, step)
            view = AttendedState.of(mission, request, step)
            if view.rows:
                ways[way] = self._put(mission, view)
            if way == GUIDED:
                reserved = mission.reservations.of_others(step, uav)
                situation = RolloutState.of(mission.belief, mission.scenario, step, uav, reserved=reserved)
            mission.commit(view.pending(name, Action(choice.sensor, choice.velocity)), attempt)
        if situation is not None and len(ways) == len(self._missions):
            self.asked.append(Asked(self._seed, step, uav, ways, situation))
        return choice

    def _put(self, mission: Mission, view: AttendedState) -> Put:
        shown = view.shown()
        if not isinstance(mission.template, GuidedTemplate):
            return Put(mission.template.prompt(view.state, shown, mission.experiences.block), view.kept_ids)
        offer = candidates_of(view, template_of(mission))
        self._note(mission, mission.template, view, offer)
        return Put(mission.template.choice_prompt(offer, view.state, mission.experiences.block), view.kept_ids, offer)

    def _note(self, mission: Mission, template: GuidedTemplate, view: AttendedState, offer: CandidateSet) -> None:
        self._step = {uav: had for uav, had in self._step.items() if had[1].step == view.step}
        self._step[view.uav_id] = offer, view
        if len(self._step) == mission.scenario.uavs:
            shares = template.fleet_prompts(
                {u: (o, v.state) for u, (o, v) in self._step.items()}, mission.experiences.block
            )
            first = next(iter(shares.values()))
            state = "".join(share.state for share in shares.values())
            whole = Prompt(template.fleet_static, first.experiences, state, first.uncompressed)
            self.together.append(Together(view.step, whole, [list(o.labels) for o, _ in self._step.values()]))

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        """Keep the outcome for this UAV's next request."""
        self._owed[uav] = Outcome(decision_id=self._decided[uav], cost=cost, failed=failed)


def missions(scenario: Scenario, seed: int) -> dict[str, Mission]:
    """The edge's mission for each of ``WAYS``, with the default settings."""
    settings = Settings(llm_context=CONTEXT, llm_adapter="off")

    def made(name: str, **spec: Any) -> Mission:
        return Mission(name, MissionSpec(scenario=scenario, seed=seed, planner="off", **spec), settings)

    return {
        GUIDED: made(GUIDED, mode="guided"),
        LLM: made(LLM, mode="llm"),
        PAPER: made(PAPER, mode="llm", attention="off"),
    }


def flown(scenario: Scenario, seed: int, policy: str = _POLICY) -> Scribe:
    """Fly and record one mission."""
    scribe = Scribe(scenario, seed, policy)
    fly(Site(scenario), scribe, seed)
    return scribe
