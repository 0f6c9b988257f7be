"""Mode ``guided``: advisers weighed by learned trust, and a rollout evaluator that estimates a decision's losses.

The candidates are the rows' sensors at a few velocities each, and the advisers' own proposals. Adviser e (the LLM, the
planner, the learned values, the LLM-free policy) gives them probabilities p_e(a), trust gives it the weight w_e, and
the rollout evaluator expects a candidate to lose m(a) packets above the best, or above the plan's. The UAV flies

    argmax_a  ln(sum_e w_e p_e(a)) - rate min(m(a), cap),    rate = 0.6 a packet, cap = 8 packets

This is Hedge over pairs of an adviser and a candidate, with the evaluation as the prediction of this very decision's
loss: optimistic Hedge (Rakhlin and Sridharan 2013), whose regret shrinks with the prediction's error. So an adviser is
overruled if the evaluator expects a large loss, even before trust has learned; and as trust grows, an adviser's
preference counts for more than the evaluator's small differences. The best is taken rather than a draw: losses are
estimated for every candidate, so that exploring would teach nothing, and cost packets.

The weights and their guarantee are in :mod:`service.learning.trust`; the evaluator is
:mod:`service.deciding.rollout_evaluator`.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from service.deciding.advisers import ADVISERS, SMOOTHING
from service.deciding.attended_state import AttendedState
from service.deciding.rollout_evaluator import Evaluation, evaluate
from service.deciding.rollout_state import RolloutState
from service.learning.trust import CAP, LLM, PLANNER, RATE, Advice, Trust
from service.llm.answers import Completion
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet, Viewpoint
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.prompt import Prompt
from shared.wire.reasons import Reason
from shared.wire.schemas import Guided, Weighed
from shared.world.channel import FloatArray
from shared.world.step_rule import Action

# Candidates that a response names.
_REPORTED = 5


@dataclass(frozen=True, slots=True)
class LlmAdvice:
    """The LLM's preference among one UAV's candidates in mode ``guided``.

    Attributes:
        prompt: of a query about several UAVs, this UAV's share of it; the first UAV's share has the static block and
            the experiences too, and the whole query's ``completion``.
        probabilities: by action; None if the LLM gave none, for the ``reason``.
        calibrated: whether the LLM's bias towards labels is known.
        model: the LLM's name, if it is known.
    """

    prompt: Prompt
    probabilities: dict[Action, float] | None
    reason: Reason | None
    completion: Completion | None
    calibrated: bool
    model: str | None

    def over(self, actions: Sequence[Action]) -> FloatArray | None:
        """The probabilities of these actions, ``(n,)``; None if the LLM gave none for any of them.

        The probability of a velocity that is not among them goes to the sensor's nearest: the operator may have
        forbidden it since.
        """
        found = np.zeros(len(actions))
        index = {action: i for i, action in enumerate(actions)}
        for action, probability in (self.probabilities or {}).items():
            at = index.get(action)
            if at is None:
                same = [other for other in actions if other.sensor_id == action.sensor_id]
                if not same:
                    continue
                at = index[min(same, key=lambda other: abs(other.velocity - action.velocity))]
            found[at] += probability
        return found / found.sum() if found.sum() > 0.0 else None


@dataclass(frozen=True, slots=True)
class Conclusion:
    """The action to fly, its report for the response, and the advice from which trust learns."""

    action: Action
    report: Guided
    advice: Advice


@dataclass(frozen=True, slots=True)
class Deliberation:
    """One decision's candidates, n of them, and the LLM-free advisers' probabilities of them ``(n,)`` by name.

    It is a snapshot of the mission's knowledge, of which ``take_rollout`` has a copy; ``evaluate`` may run in another
    thread.
    """

    candidates: CandidateSet
    prompt: Prompt
    advised: dict[str, FloatArray]
    take_rollout: Callable[[], RolloutState]

    @classmethod
    def of(cls, state: AttendedState) -> Self:
        """For a state of a mission of mode ``guided`` with at least one row."""
        mission = state.mission
        preferences = {name: found for name, advise in ADVISERS.items() if (found := advise(state)) is not None}
        template, proposals = template_of(mission), [found.action for found in preferences.values()]
        candidates = candidates_of(state, template).with_actions(proposals)
        take_rollout = partial(
            RolloutState.of,
            mission.belief.copy(),
            mission.scenario,
            state.step,
            state.uav_id,
            seed=mission.spec.seed,
            reserved=state.reserved,
            plans={} if mission.planner is None else dict(mission.planner.plans),
            guidance=mission.guidance.confirmed,
        )
        return cls(
            candidates=candidates,
            prompt=template.choice_prompt(candidates, state.state, mission.experiences.block),
            advised={name: found.probabilities(candidates.actions) for name, found in preferences.items()},
            take_rollout=take_rollout,
        )

    def evaluate(self) -> Evaluation:
        """The rollout evaluator's expectations for every candidate."""
        return evaluate(self.take_rollout(), self.candidates.actions)

    def conclude(
        self,
        trust: Trust,
        evaluation: Evaluation,
        llm: FloatArray | None,
        *,
        calibrated: bool,
        reserved: Collection[int] = (),
    ) -> Conclusion | None:
        """Weigh the advice; None if every candidate's sensor is reserved.

        Args:
            llm: the LLM's probabilities of the candidates, ``(n,)``; None if it gave none.
            calibrated: whether the LLM's bias towards labels is known.
            reserved: sensors that other UAVs have reserved meanwhile.
        """
        given = dict(self.advised)
        if llm is not None:
            # An action without a label is as likely as one that the LLM rules out.
            given[LLM] = (1.0 - SMOOTHING) * llm + SMOOTHING / len(llm)
        weights = trust.among(given)
        mixture = np.sum([weights[name] * p for name, p in given.items()], axis=0)
        regret = self._regret(evaluation.lost)
        score = np.log(mixture) - RATE * np.minimum(regret, CAP)
        free = ~np.isin([sensor for sensor, _ in self.candidates.actions], list(reserved))
        if not free.any():
            return None
        score = np.where(free, score, -np.inf)
        best = int(score.argmax())
        advice = Advice(
            regret={name: float(p @ np.minimum(regret, CAP)) for name, p in given.items()},
            flown={name: float(p[best]) for name, p in given.items()},
            expected_cost=float(evaluation.cost[best]),
        )
        report = Guided(
            trust={name: round(weight, 4) for name, weight in trust.weights.items()},
            calibrated=calibrated,
            candidates=self._reported(score, mixture, regret, given.get(LLM)),
        )
        return Conclusion(self.candidates.actions[best], report, advice)

    def _regret(self, lost: FloatArray) -> FloatArray:
        """Packets lost above the best candidate, or above the plan's action unless that loses far more.

        The plan looks further than the evaluator, which flies look-ahead after the candidates and ends with its
        horizon. Faulted for less than the cap, the planner was wrongly overruled while most sensors were unheard.
        """
        least = lost.min()
        if PLANNER in self.advised:
            planned = lost[self.advised[PLANNER].argmax()]
            least = planned if planned - least < CAP else least
        return np.asarray(np.maximum(lost - least, 0.0))

    def _reported(
        self, score: FloatArray, mixture: FloatArray, regret: FloatArray, llm: FloatArray | None
    ) -> list[Weighed]:
        """The best candidates whose sensors are free, best first."""
        best = np.argsort(-score, kind="stable")[:_REPORTED].tolist()
        return [
            Weighed(
                sensor_id=self.candidates.actions[i].sensor_id,
                velocity=self.candidates.actions[i].velocity,
                llm=None if llm is None else round(float(llm[i]), 4),
                mixture=round(float(mixture[i]), 4),
                regret=round(float(regret[i]), 3),
                score=round(float(score[i]), 4),
            )
            for i in best
            if score[i] > -np.inf
        ]


def template_of(mission: Mission) -> GuidedTemplate:
    """The mission's prompt template; raises ``TypeError`` if it flies in another mode."""
    if not isinstance(mission.template, GuidedTemplate):
        raise TypeError(f"mission {mission.mission_id} flies in mode {mission.mode}, not guided")
    return mission.template


def candidates_of(state: AttendedState, template: GuidedTemplate) -> CandidateSet:
    """The LLM's candidates, at velocities that the operator allows; the state has at least one row."""
    mission, shown = state.mission, state.prompt_view
    view = Viewpoint(mission.belief, state.uav_id, state.step, learned=mission.belief_source == "fleet")
    if shown.guidance is not None:
        view = replace(view, nearest=shown.guidance.nearest)
    seen, offered = shown.reach or state.reach, shown.offered or state.reach
    return template.candidates(shown.state, seen, offered, state.shown(), view)
