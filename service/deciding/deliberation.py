"""Mode ``guided``: advisers weighed by learned trust, and a critic that sees what this decision would lose.

The candidates are the rows' sensors at a few velocities each, and what the advisers would do themselves. Adviser e (the
LLM, the planner, the learned values, the LLM-free policy) gives them probabilities p_e(a), trust gives it the weight
w_e, and the critic expects a candidate to lose m(a) packets above the best, or above the plan's. What is flown is

    argmax_a  ln(sum_e w_e p_e(a)) - rate min(m(a), cap),    rate = 0.6 a packet, cap = 8 packets

This is Hedge over pairs of an adviser and a candidate, with the critic's judgement as the prediction of this very
decision's loss: optimistic Hedge (Rakhlin and Sridharan 2013), whose regret shrinks with the prediction's error. So an
adviser is overruled where the critic sees a disaster, even before trust has learned; and as trust grows, its word
counts for more than the critic's small differences. The best is taken rather than a draw: losses are estimated for
every candidate, so that exploring would teach nothing, and cost packets.

The weights and what they guarantee are in :mod:`service.learning.trust`; the critic is
:mod:`service.deciding.rollout_evaluator`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Self

import numpy as np

from service.deciding.advisers import ADVISERS, SMOOTHING
from service.deciding.attended_state import AttendedState
from service.deciding.rollout_evaluator import Judgement, RolloutState, judge
from service.learning.trust import CAP, LLM, PLANNER, RATE, Advice, Trust
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.prompt import Prompt
from shared.actions import Action
from shared.channel import FloatArray
from shared.wire import Guided, Weighed

_TOLD = 5


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is flown, what the response tells of it, and what trust is to learn from it."""

    action: Action
    told: Guided
    advice: Advice


@dataclass(frozen=True, slots=True)
class Deliberation:
    """One decision's candidates, the LLM-free advisers' probabilities of them ``(n,)`` by name, and the situation.

    Taken at once from what the mission knows then; ``judge`` may run in another thread.
    """

    offer: CandidateSet
    prompt: Prompt
    advised: dict[str, FloatArray]
    situation: RolloutState

    @classmethod
    def of(cls, mission: Mission, view: AttendedState) -> Self:
        """For a mission of mode ``guided`` and a view with at least one row."""
        template = template_of(mission)
        shown = offered(mission, view)
        proposed = {expert: action for expert in ADVISERS if (action := expert.proposal(mission, view)) is not None}
        offer = shown.with_actions(list(proposed.values()))
        reserved = mission.reserved(view.step, view.uav_id)
        situation = RolloutState.of(
            mission.belief,
            mission.scenario,
            view.step,
            view.uav_id,
            seed=mission.spec.seed,
            reserved=reserved,
            course=None if mission.planner is None else mission.planner.course(),
            guidance=mission.guidance.obeyed,
        )
        return cls(
            offer=offer,
            prompt=template.offer(offer, view.state, mission.experiences, view.nearest(mission)),
            advised={expert.name: expert.probabilities(mission, view, offer.actions) for expert in proposed},
            situation=situation,
        )

    def judge(self) -> Judgement:
        """What the critic expects of every candidate."""
        return judge(self.situation, self.offer.actions)

    def _regret(self, lost: FloatArray) -> FloatArray:
        """Packets lost above the best candidate, or above the plan's unless that is a disaster.

        The plan looks further than the critic, which flies look-ahead after the candidates and stops where it stops:
        faulted for less than the cap, the planner was overruled in 3 of 46 worlds of scenario `paper`, each time while
        most sensors were unheard of. One of these lost 96 packets instead of 22, one 0 instead of 7.
        """
        least = lost.min()
        if PLANNER in self.advised:
            planned = lost[self.advised[PLANNER].argmax()]
            least = planned if planned - least < CAP else least
        return np.asarray(np.maximum(lost - least, 0.0))

    def conclude(
        self,
        trust: Trust,
        judgement: Judgement,
        llm: FloatArray | None,
        *,
        calibrated: bool,
        gone: Collection[int] = (),
    ) -> Verdict | None:
        """Weigh the advice; None where every candidate's sensor is gone.

        Args:
            llm: the LLM's probabilities of the offer's actions, ``(n,)``; None where it was silent.
            gone: sensors that others were given meanwhile.
        """
        spoken = dict(self.advised)
        if llm is not None:
            # What no label names is as likely as what the LLM ruled out.
            spoken[LLM] = (1.0 - SMOOTHING) * llm + SMOOTHING / len(llm)
        weights = trust.among(spoken)
        mixture = np.sum([weights[name] * p for name, p in spoken.items()], axis=0)
        regret = self._regret(judgement.lost)
        score = np.log(mixture) - RATE * np.minimum(regret, CAP)
        free = ~np.isin([sensor for sensor, _ in self.offer.actions], list(gone))
        if not free.any():
            return None
        best = int(np.where(free, score, -np.inf).argmax())
        advice = Advice(
            regret={name: float(p @ np.minimum(regret, CAP)) for name, p in spoken.items()},
            flown={name: float(p[best]) for name, p in spoken.items()},
            expected_cost=float(judgement.cost[best]),
        )
        llm_told = spoken.get(LLM)
        weighed = [
            Weighed(
                sensor_id=self.offer.actions[i][0],
                velocity=self.offer.actions[i][1],
                llm=None if llm_told is None else round(float(llm_told[i]), 4),
                mixture=round(float(mixture[i]), 4),
                regret=round(float(regret[i]), 3),
                score=round(float(score[i]), 4),
            )
            for i in np.argsort(-np.where(free, score, -np.inf), kind="stable")[:_TOLD].tolist()
            if free[i]
        ]
        shares = {name: round(weight, 4) for name, weight in trust.weights.items()}
        return Verdict(
            self.offer.actions[best], Guided(trust=shares, calibrated=calibrated, candidates=weighed), advice
        )


def template_of(mission: Mission) -> GuidedTemplate:
    """The mission's prompt; raises ``TypeError`` where it flies in another mode."""
    if not isinstance(mission.template, GuidedTemplate):
        raise TypeError(f"mission {mission.mission_id} flies in mode {mission.mode}, not guided")
    return mission.template


def offered(mission: Mission, view: AttendedState) -> CandidateSet:
    """What the LLM may choose from, at velocities that the operator allows; the view has at least one row."""
    letters = template_of(mission).letters
    shown = CandidateSet.of(view.state, view.shown(mission), view.uav_id, letters, mission.scenario)
    asked = view.asked
    if asked is None:
        return shown
    rows = {int(sensor): row for row, sensor in enumerate(view.state.ids)}
    return shown.flown_as(lambda sensor, velocity: asked.nearest(rows[sensor], velocity))
