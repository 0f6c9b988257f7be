"""Asking the LLM, within a deadline: of one UAV's decision, or of all UAVs of a step at once."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import offered, template_of
from service.llm.answer_format import NoDecision
from service.llm.calibration import LabelReader
from service.llm.completion import Completion
from service.llm.server_pool import ServerPool
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.prompting.candidates import CandidateSet
from service.prompting.prompt import Prompt
from shared.actions import Action
from shared.channel import FloatArray
from shared.wire import Reason

log = logging.getLogger(__name__)

# After SIGTERM, so that every UAV is answered before the process is killed.
_HURRY_S = 4.0
# Calls about several UAVs that may run late in a row before they are asked about one by one.
_LATE = 2


@dataclass(frozen=True, slots=True)
class LlmAdvice:
    """What the LLM said of one UAV's candidates in mode ``guided``.

    ``told`` holds the probabilities of the actions that it was asked about; None where it was silent, for the
    ``reason``; ``model`` is whose word it is. Where several UAVs were asked about at once, ``prompt`` is this one's
    share, and the whole call's static block, experiences and ``completion`` are with the first.
    """

    prompt: Prompt
    told: dict[Action, float] | None
    reason: Reason | None
    completion: Completion | None
    calibrated: bool
    model: str | None

    def of(self, actions: Sequence[Action]) -> FloatArray | None:
        """Its probabilities of these actions, ``(n,)``; None where it said nothing of any.

        A velocity that is not among them, because the operator forbade it meanwhile, counts as the sensor's nearest.
        """
        found = np.zeros(len(actions))
        for (sensor, velocity), probability in (self.told or {}).items():
            there = [i for i, action in enumerate(actions) if action[0] == sensor]
            if there:
                found[min(there, key=lambda i: abs(actions[i][1] - velocity))] += probability
        return found / found.sum() if found.sum() > 0.0 else None


class LlmQueries:
    """Asks one LLM for every mission of a service, ``most`` decisions at once."""

    def __init__(self, llm: ServerPool, metrics: Metrics, most: int) -> None:
        self._llm = llm
        self._most = most
        self._metrics = metrics
        self._labels = LabelReader(llm)
        self._late = 0
        self._waiting: set[asyncio.Timeout] = set()
        self._closing = False

    def hurry(self) -> None:
        """Closing time: who still waits for the LLM does so for a few seconds more."""
        self._closing = True
        ends = asyncio.get_running_loop().time() + _HURRY_S
        for limit in self._waiting:
            # One that has just expired is on its way out, and cannot be changed.
            if not limit.expired():
                limit.reschedule(min(limit.when() or ends, ends))

    async def close(self) -> None:
        """Give up what goes on in the background."""
        await self._labels.close()

    async def pair(self, prompt: Prompt, sensor_ids: list[int], levels: int, deadline: float) -> Completion:
        """Mode ``llm``: a sensor and a velocity; raises ``NoDecision``. Deadlines are of ``time.perf_counter``."""
        return await self._within(self._llm.ask(prompt.static, prompt.user, sensor_ids, levels), deadline)

    async def word(self, mission: Mission, offer: CandidateSet, prompt: Prompt, deadline: float) -> LlmAdvice:
        """Mode ``guided``: what the LLM says of one UAV's candidates."""
        template = template_of(mission)
        lists = [list(offer.labels)]
        completion, told, reason = await self._heard(mission, prompt.static, prompt.user, lists, deadline)
        calibrated, model = self._knows(completion, prompt.static, lists), self._model(completion)
        if told is None:
            return LlmAdvice(prompt, None, reason, completion, calibrated, model)
        self._labels.calibrate(model, prompt.static, template.content_free(), [template.labels])
        return LlmAdvice(prompt, by_action(offer, told[0]), None, completion, calibrated, model)

    def may_ask_together(self, mission: Mission, uavs: int) -> bool:
        """Whether one call can decide for so many UAVs: in mode ``guided``, of a server that can, if it holds them."""
        able = self._llm.status == "ready" and uavs <= self._llm.most_together
        return able and mission.mode == "guided" and uavs > 1 and mission.holds(uavs)

    async def words(self, mission: Mission, views: Sequence[AttendedState], deadline: float) -> dict[int, LlmAdvice]:
        """Mode ``guided``: what the LLM says of every UAV's candidates, by UAV, asked in one call.

        Where that fails before the deadline, nothing is returned, and the LLM is asked about so many UAVs no more until
        it is probed again; after two timeouts in a row neither.
        """
        template = template_of(mission)
        asked = {view.uav_id: (view, offered(mission, view)) for view in views if view.rows}
        if not asked:
            return {}
        nearest = dict.fromkeys(line for view, _ in asked.values() for line in view.nearest(mission))
        prompts = template.together(
            {uav: (offer, view.state) for uav, (view, offer) in asked.items()}, mission.experiences, list(nearest)
        )
        static, user = template.static_together, "".join(prompt.user for prompt in prompts.values())
        lists = [list(offer.labels) for _, offer in asked.values()]
        completion, told, reason = await self._heard(mission, static, user, lists, deadline)
        self._late = self._late + 1 if reason == "llm_timeout" else 0
        if reason is not None and (self._late == 0 or self._late >= _LATE):
            log.warning("the LLM does not decide for %d UAVs at once (%s): asked one by one", len(asked), reason)
            self._llm.most_together = len(asked) - 1
            self._late = 0
        if reason is not None and reason != "llm_timeout":
            return {}
        calibrated, model = self._knows(completion, static, lists), self._model(completion)
        if told is not None:
            self._labels.calibrate(model, static, template.content_free(list(asked)), [template.labels] * len(asked))
        words = {}
        for place, (uav, (_, offer)) in enumerate(asked.items()):
            heard = None if told is None else by_action(offer, told[place])
            words[uav] = LlmAdvice(prompts[uav], heard, reason, None if place else completion, calibrated, model)
        return words

    async def _heard(
        self, mission: Mission, static: str, user: str, lists: Sequence[Sequence[str]], deadline: float
    ) -> tuple[Completion | None, list[dict[str, float]] | None, Reason | None]:
        completion, told, reason = None, None, None
        try:
            completion = await self._within(self._labels.ask(static, user, lists), deadline)
            told = self._labels.read(completion, static, lists)
        except NoDecision as error:
            log.debug("mission %s: %s: %s", mission.mission_id, error.reason, error)
            reason = error.reason
        self._metrics.llm_requests.labels(reason or "ok").inc()
        return completion, told, reason

    def _model(self, completion: Completion | None) -> str | None:
        """Who said it, or would have."""
        return self._llm.model if completion is None else completion.model

    def _knows(self, completion: Completion | None, static: str, lists: Sequence[Sequence[str]]) -> bool:
        known = self._labels.bias(self._model(completion), static, len(lists)) is not None
        return known and completion is not None and bool(completion.places)

    async def _within(self, asked: Coroutine[Any, Any, Completion], deadline: float) -> Completion:
        if len(self._waiting) >= self._most:
            asked.close()
            raise NoDecision("llm_busy", f"{self._most} decisions wait for it already")
        limit = asyncio.timeout(min(deadline - time.perf_counter(), _HURRY_S if self._closing else math.inf))
        try:
            async with limit:
                self._waiting.add(limit)
                return await asked
        except TimeoutError:
            raise NoDecision("llm_timeout", "no answer within the deadline") from None
        finally:
            self._waiting.discard(limit)


def by_action(offer: CandidateSet, told: dict[str, float]) -> dict[Action, float]:
    """Probabilities of an offer's labels as those of its actions."""
    return dict(zip(offer.actions, offer.spread(told).tolist(), strict=True))
