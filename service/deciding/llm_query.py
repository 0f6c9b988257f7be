"""Queries to the LLM, within a deadline: about one UAV's decision, or about all UAVs of a step at once."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial

from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import LlmAdvice, candidates_of, template_of
from service.deciding.stopwatch import Deadline
from service.llm.answers import Busy, Completion, NoDecision, check_answer, raised
from service.llm.calibration import LabelReader
from service.llm.server_pool import ServerPool
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.prompting.candidates import CandidateSet
from service.prompting.prompt import Prompt
from shared.wire.reasons import Reason
from shared.world.step_rule import Action

log = logging.getLogger(__name__)

# Consecutive late queries about a whole fleet after which the LLM is asked about one UAV at a time.
_LATE = 2
# The most that a query may take after SIGTERM, so that every UAV is answered before the process is killed.
_CLOSING_S = 4.0


class QueryLimits:
    """Bounds the queries to the LLM in time and in number: at most ``most`` wait."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._waiting: set[asyncio.Timeout] = set()
        self._closing = False

    def hurry(self) -> None:
        """Shorten the limits because the service is closing: a waiting query gets a few more seconds."""
        self._closing = True
        ends = asyncio.get_running_loop().time() + _CLOSING_S
        for limit in self._waiting:
            # A limit that has just expired cannot be changed.
            if not limit.expired():
                limit.reschedule(min(limit.when() or ends, ends))

    async def within(self, query: Callable[[], Awaitable[Completion]], deadline: Deadline) -> Completion:
        """The query's answer, after the pause that the server asks for if the deadline leaves time for it.

        Raises:
            NoDecision: no answer before the deadline, or too many queries are waiting.
        """
        if len(self._waiting) >= self._most:
            raise NoDecision("llm_busy", f"{self._most} decisions wait for it already")
        limit = asyncio.timeout(min(deadline.left(), _CLOSING_S if self._closing else math.inf))
        try:
            async with limit:
                self._waiting.add(limit)
                while True:
                    try:
                        return await query()
                    except Busy as busy:
                        if busy.pause_s >= deadline.left():
                            raise
                        await asyncio.sleep(busy.pause_s)
        except TimeoutError:
            raise NoDecision("llm_timeout", "no answer within the deadline") from None
        finally:
            self._waiting.discard(limit)


@dataclass(frozen=True, slots=True)
class _Answer:
    """A query's answer: the probabilities of each UAV's labels, or the reason why there are none.

    ``model`` is the LLM that was called; ``to_calibrate`` says that its bias can be measured and is not known yet.
    """

    completion: Completion | None
    by_label: list[dict[str, float]] | None
    reason: Reason | None
    calibrated: bool
    to_calibrate: bool
    model: str | None


class LlmQueries:
    """Asks one LLM for every mission of a service, a bounded number of decisions at a time."""

    def __init__(self, llm: ServerPool, metrics: Metrics, limit: int) -> None:
        self._llm = llm
        self._metrics = metrics
        self._labels = LabelReader()
        self._late = 0
        self._limits = QueryLimits(limit)

    def hurry(self) -> None:
        """Shorten the limits because the service is closing: a waiting query gets a few more seconds."""
        self._limits.hurry()

    async def close(self) -> None:
        """Cancel the queries in the background."""
        await self._labels.close()

    async def ask_for_pair(
        self, mission: Mission, prompt: Prompt, sensor_ids: list[int], levels: int, deadline: Deadline
    ) -> Completion:
        """Mode ``llm``: a sensor and a velocity; raises ``NoDecision``."""
        query = partial(self._llm.ask, mission.mission_id, prompt.static, prompt.user, sensor_ids, levels)
        try:
            return await self._limits.within(query, deadline)
        except NoDecision as fault:
            self._llm.record_usability(mission.mission_id, fault)
            raise

    def read_pair(self, mission: Mission, completion: Completion, sensor_ids: list[int], levels: int) -> Action:
        """The sensor and the velocity of an answer; raises ``NoDecision``."""
        try:
            answer = check_answer(completion.text, sensor_ids, levels)
        except NoDecision as fault:
            self._llm.record_usability(mission.mission_id, fault, completion.url)
            raise
        self._llm.record_usability(mission.mission_id, None, completion.url)
        return answer

    async def ask(self, mission: Mission, candidates: CandidateSet, prompt: Prompt, deadline: Deadline) -> LlmAdvice:
        """Mode ``guided``: the LLM's preference among one UAV's candidates."""
        if not mission.prompt_fits:
            model = self._llm.serving(mission.mission_id).connection.model
            return LlmAdvice(prompt, None, "llm_unavailable", None, calibrated=False, model=model)
        template = template_of(mission)
        answer = await self._query(mission, prompt.static, prompt.user, [list(candidates.labels)], deadline)
        if answer.to_calibrate:
            ask = partial(self._llm.ask_labels, mission.mission_id)
            self._labels.calibrate(ask, answer.model, prompt.static, template.content_free(), [template.labels])
        probabilities = None
        if answer.by_label is not None:
            probabilities = candidates.by_action(raised(answer.by_label[0], template.sharpness))
        return LlmAdvice(prompt, probabilities, answer.reason, answer.completion, answer.calibrated, answer.model)

    def may_ask_for_fleet(self, mission: Mission, uavs: int) -> bool:
        """Whether one query can serve this many UAVs: mode ``guided``, a capable server, a sufficient context."""
        server = self._llm.serving(mission.mission_id)
        able = server.status.llm == "ready" and uavs <= server.connection.abilities.max_uavs_per_call
        return able and mission.mode == "guided" and uavs > 1 and mission.prompt_fit.fits(uavs)

    async def ask_for_fleet(
        self, mission: Mission, states: Sequence[AttendedState], deadline: Deadline
    ) -> dict[int, LlmAdvice]:
        """Mode ``guided``: the LLM's preferences for several UAVs, by UAV, in one query.

        If the query fails before the deadline, the result is empty, and the LLM gets no queries about this many UAVs
        until it is probed again; the same applies after two timeouts in a row.
        """
        template = template_of(mission)
        asked = {state.uav_id: (state, candidates_of(state, template)) for state in states if state.rows}
        if not asked:
            return {}
        prompts = template.fleet_prompts(
            {uav: (candidates, state.state) for uav, (state, candidates) in asked.items()}, mission.experiences.block
        )
        static, user = template.fleet_static, "".join(prompt.user for prompt in prompts.values())
        labels = [list(candidates.labels) for _, candidates in asked.values()]
        answer = await self._query(mission, static, user, labels, deadline)
        self._note_lateness(mission, len(asked), answer.reason)
        if answer.reason is not None and answer.reason != "llm_timeout":
            return {}
        if answer.to_calibrate:
            texts = template.content_free(list(asked))
            ask = partial(self._llm.ask_labels, mission.mission_id)
            self._labels.calibrate(ask, answer.model, static, texts, [template.labels] * len(asked))
        advice = {}
        for index, (uav, (_, candidates)) in enumerate(asked.items()):
            probabilities = None if answer.by_label is None else candidates.by_action(answer.by_label[index])
            whole = None if index else answer.completion
            advice[uav] = LlmAdvice(prompts[uav], probabilities, answer.reason, whole, answer.calibrated, answer.model)
        return advice

    def _note_lateness(self, mission: Mission, uavs: int, reason: Reason | None) -> None:
        """Ask about fewer UAVs at once if the LLM failed or is late again."""
        self._late = self._late + 1 if reason == "llm_timeout" else 0
        if reason is not None and (self._late == 0 or self._late >= _LATE):
            log.warning("the LLM does not decide for %d UAVs at once (%s): asked one by one", uavs, reason)
            self._llm.serving(mission.mission_id).connection.abilities.max_uavs_per_call = uavs - 1
            self._late = 0

    async def _query(
        self, mission: Mission, static: str, user: str, labels: Sequence[Sequence[str]], deadline: Deadline
    ) -> _Answer:
        completion, by_label, reason = None, None, None
        try:
            query = partial(self._llm.ask_labels, mission.mission_id, static, user, labels)
            completion = await self._limits.within(query, deadline)
            by_label = self._labels.read(completion, static, labels)
            self._llm.record_usability(mission.mission_id, None, completion.url)
        except NoDecision as error:
            self._llm.record_usability(mission.mission_id, error, completion.url if completion else None)
            log.debug("mission %s: %s: %s", mission.mission_id, error.reason, error)
            reason = error.reason
        self._metrics.llm_requests.labels(reason or "ok").inc()
        if completion is None:
            model = self._llm.serving(mission.mission_id).connection.model
            return _Answer(None, None, reason, calibrated=False, to_calibrate=False, model=model)
        known = bool(completion.positions) and self._labels.bias(completion.model, static, len(labels)) is not None
        unknown = by_label is not None and bool(completion.positions) and not known
        return _Answer(completion, by_label, reason, calibrated=known, to_calibrate=unknown, model=completion.model)
