"""The decision pipeline: augment, attend, prompt, ask, check, answer; and feedback, from which the modules learn."""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from pydantic import TypeAdapter

from service.config.cores import usable_cores
from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.decision_task import RESERVE_S, Choice, DecisionTask
from service.deciding.deliberation import Deliberation
from service.deciding.llm_query import LlmAdvice, LlmQueries
from service.deciding.look_ahead import decide_without_llm
from service.deciding.verifier import verify
from service.edge.feedback import Feedback
from service.edge.mission_registry import MissionRegistry
from service.errors import Unavailable
from service.guidance.note_compiler import NoteCompiler
from service.learning.trust import LLM
from service.live.broadcaster import Broadcaster
from service.llm.answer_format import NoDecision, check_answer
from service.llm.completion import Completion
from service.llm.server_pool import ServerPool
from service.mission.events import AdviserReport
from service.mission.mission import Mission
from service.observability import logs
from service.observability.metrics import Metrics
from service.observability.stopwatch import Stopwatch
from service.observability.tracing import Traces
from service.prompting.prompt import Prompt
from service.prompting.token_accounting import TokenCounter, with_usage
from service.storage.journal import Journal, NullJournal
from service.storage.store import Store
from shared.actions import Action
from shared.wire import (
    BatchRequest,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    Reason,
)

log = logging.getLogger(__name__)

# Of a batch's time, the most that the LLM may take which is asked about all of its UAVs at once, and the least that it
# is asked for: what it leaves is for weighing one UAV's candidates after the other's, reckoned twice.
_TOGETHER_MOST, _TOGETHER_LEAST = 0.75, 0.25
# A UAV's own share, seconds, until it is known, and how many decisions it is learned over.
_OWN_S, _OWN_MEMORY = 0.03, 20
# The longest that an answer waits for the disk; where that takes longer, it goes out and says so.
_STORE_S = 1.0
# The last checkpoints, and the last commit, when the service ends.
_LAST_CHECKPOINTS_S, _LAST_COMMIT_S = 2.0, 2.5
_ANSWERS = TypeAdapter(list[DecideResponse])


class Engine:
    """Decides for every mission of one service, and learns from what comes back."""

    def __init__(
        self,
        settings: Settings,
        llm: ServerPool,
        counter: TokenCounter,
        metrics: Metrics,
        traces: Traces,
        store: Store | None,
    ) -> None:
        self._traces = traces
        self._settings = settings
        self._llm = llm
        self.asking = LlmQueries(llm, metrics, settings.llm_concurrency)
        self.compiler = NoteCompiler(llm)
        self._counter = counter
        self._metrics = metrics
        self._planning = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="planner")
        self._judging = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="critic")
        self._plans: set[asyncio.Task[None]] = set()
        self._own_s = _OWN_S
        self.keeper: Journal | NullJournal = NullJournal() if store is None else Journal(store, metrics)
        self.live = Broadcaster()
        self._outcomes = Feedback(metrics, self.keeper, self.live)
        self.missions = MissionRegistry(settings, metrics, self.keeper, store, self.compiler.compile)

    def hurry(self) -> None:
        """Closing time: who waits for the LLM does so for a few seconds more, and pages are told no more."""
        self.asking.hurry()
        self.live.close()

    async def close(self) -> bool:
        """Finish the lessons and the plan in hand, drop the plans that are queued, and write what is to be kept.

        Returns:
            whether the store may be closed: False while a write that was given up still waits for it.
        """
        self._outcomes.finish()
        for threads in (self._planning, self._judging):
            await asyncio.to_thread(threads.shutdown, cancel_futures=True)
        self.missions.close()
        await self._outcomes.close(self.missions.loaded, _LAST_CHECKPOINTS_S)
        return await self.keeper.close(_LAST_COMMIT_S)

    async def decide(self, request: DecideRequest, *, may_make: bool = True, key: str | None = None) -> DecideResponse:
        """One UAV's decision, within its deadline whatever the LLM does; raises ``Refused`` for bad input.

        Args:
            key: a request that comes again under it gets the same answer.
        """
        watch = Stopwatch()
        logs.bind(request.mission_id, request.step)
        ends = watch.started + (request.deadline_ms or self._settings.deadline_ms) / 1e3
        within_s = ends - RESERVE_S - time.perf_counter()
        mission, whole = await self.missions.checked(request, may_make=may_make, key=key, within_s=within_s)
        return (await self._once(mission, key, request, lambda: self._one(mission, whole, watch), ends))[0]

    async def _one(self, mission: Mission, request: DecideRequest, watch: Stopwatch) -> list[DecideResponse]:
        if request.outcome is not None:
            self._outcomes.take(mission, request.outcome)
        deadline_ms = request.deadline_ms or self._settings.deadline_ms
        attempt = mission.observe(request, request.step)
        plan = self._plan(mission, [request.uav_id], request.step, watch.started + deadline_ms / 1e3)
        return [await self._decide(mission, DecisionTask(request, request.step, attempt, deadline_ms, watch, plan))]

    async def decide_batch(
        self, request: BatchRequest, *, may_make: bool = True, key: str | None = None
    ) -> list[DecideResponse]:
        """A fleet's decisions in the order asked; ``key`` as for :meth:`decide`.

        All that the UAVs report is known before the first decides, and one plan serves them all, until a UAV is told
        something else than it: then the rest is planned again. The LLM is asked about all at once where it can be,
        while the plan is made; else about one after the other. Each UAV has an equal share of the time that is left.
        """
        watch = Stopwatch()
        logs.bind(request.mission_id, request.step)
        ends = watch.started + (request.deadline_ms or self._settings.deadline_ms) / 1e3
        within_s = ends - RESERVE_S - time.perf_counter()
        mission, whole = await self.missions.checked(request, may_make=may_make, key=key, within_s=within_s)
        return await self._once(mission, key, request, lambda: self._all(mission, whole, watch, ends), ends)

    async def _all(
        self, mission: Mission, request: BatchRequest, watch: Stopwatch, ends: float
    ) -> list[DecideResponse]:
        total_ms = request.deadline_ms or self._settings.deadline_ms
        answers: list[DecideResponse] = []
        # All at once: the first decision may use every outcome, and none can be forgotten while others wait.
        for outcome in (uav.outcome for uav in request.uavs if uav.outcome is not None):
            self._outcomes.take(mission, outcome)
        waiting = [uav.uav_id for uav in request.uavs]
        # Before the LLM is asked: a batch that is sent again meanwhile is the later attempt.
        attempts = {uav.uav_id: mission.observe(uav, request.step) for uav in request.uavs}
        plan: asyncio.Task[None] | None = None
        words: dict[int, LlmAdvice] = {}
        llm_s = min(_TOGETHER_MOST * total_ms / 1e3, total_ms / 1e3 - 2 * len(waiting) * self._own_s)
        enough = llm_s >= _TOGETHER_LEAST * total_ms / 1e3
        if enough and self.asking.may_ask_together(mission, len(waiting)):
            plan = self._plan(mission, waiting, request.step, ends)
            views = [AttendedState.of(mission, uav, request.step) for uav in request.uavs]
            for view in views:
                view.attend(mission)
            watch.lap("attend")
            words = await self.asking.words(mission, views, watch.started + llm_s)
            watch.lap("llm")
        for turn, uav in enumerate(request.uavs):
            own = Stopwatch() if turn else watch
            now = time.perf_counter()
            share_s = (ends - now) / (len(request.uavs) - turn)
            deadline_ms = max(1, int((now - own.started + share_s) * 1e3))
            plan = plan or self._plan(mission, waiting[turn:], request.step, now + share_s)
            word = words.get(uav.uav_id)
            # The critic may take more than its UAV's share, as long as it leaves the others what they need.
            latest = ends - RESERVE_S - self._own_s * (len(waiting) - turn - 1)
            its = DecisionTask(uav, request.step, attempts[uav.uav_id], deadline_ms, own, plan, word, latest)
            answer = await self._decide(mission, its)
            if mission.planner is None or mission.planner.action(uav.uav_id) != (answer.sensor_id, answer.velocity):
                plan = None
            answers.append(answer)
            await asyncio.sleep(0)
        return answers

    async def feedback(self, request: FeedbackRequest) -> FeedbackResponse:
        """Apply an outcome once; acknowledged, it is on disk.

        Raises:
            NotFound: an unknown mission or decision.
            Conflict: another outcome was told before.
            Unavailable: the store fails, or is slow; to be sent again.
        """
        mission = await self.missions.get(request.mission_id)
        self.missions.refuse_if_failing("decision_id")
        result = self._outcomes.apply(mission, request)
        try:
            await self.kept("decision_id")
        finally:
            self._checkpoint_later(mission)
        return FeedbackResponse(decision_id=request.decision_id, result=result)

    async def kept(self, field: str) -> None:
        """Wait until all that happened so far is on disk; raises ``Unavailable`` where it is not in time."""
        if not await self.keeper.stored(_STORE_S):
            raise Unavailable(field, "not on disk yet: send it again to be sure")

    def _checkpoint_later(self, mission: Mission) -> None:
        """Where one is due, when this turn of the loop has sent the answer."""
        asyncio.get_running_loop().call_soon(self._outcomes.checkpoint, mission)

    async def _once(
        self,
        mission: Mission,
        key: str | None,
        request: DecideRequest | BatchRequest,
        make: Callable[[], Awaitable[list[DecideResponse]]],
        ends: float,
    ) -> list[DecideResponse]:
        """The answers under this key, made unless there are some, and whether they are on disk."""
        made: list[DecideResponse] = []

        async def body() -> str:
            made.extend(await make())
            return _ANSWERS.dump_json(made).decode()

        if key is None:
            answers = made = await make()
        else:
            text = await mission.repeats.once(key, request.model_dump_json(), body, mission.record)
            answers = made or _ANSWERS.validate_json(text)
        began = time.perf_counter()
        stored = await self.keeper.stored(min(_STORE_S, ends - began))
        self._checkpoint_later(mission)
        waited = round((time.perf_counter() - began) * 1e3, 3)
        told = []
        for answer in answers:
            total = round(answer.latency_ms["total"] + waited, 3)
            latency = {**answer.latency_ms, "store": waited, "total": total}
            told.append(answer.model_copy(update={"stored": stored, "latency_ms": latency}))
        for answer in told if made else ():
            self._metrics.record_decision(answer)
            self._traces.decided(answer)
            logs.decided(answer)
            self.live.answered(answer)
        return told

    async def _decide(self, mission: Mission, turn: DecisionTask) -> DecideResponse:
        uav, step, watch, word = turn.uav, turn.step, turn.watch, turn.word
        if mission.mode == "guided":
            await _until(turn.plan, turn.deadline)
            watch.lap("plan")
        view = AttendedState.of(mission, uav, step)
        self._metrics.overflow_risk.observe(view.state.overflow_risk)
        watch.lap("augment")
        view.attend(mission)
        watch.lap("attend")
        deliberation = Deliberation.of(mission, view) if mission.mode == "guided" and view.rows else None
        if deliberation is not None:
            prompt = word.prompt if word else deliberation.prompt
        else:
            prompt = mission.template.prompt(
                view.state, view.shown(mission), mission.experiences, view.nearest(mission)
            )
        tokens = self._counter.account(prompt)
        watch.lap("prompt")
        if deliberation is not None:
            choice = await self._weigh(mission, view, deliberation, turn)
        else:
            choice = await self._choose(mission, view, prompt, turn)
        levels = mission.scenario.max_velocity + 1
        # Whoever decided, and whatever was confirmed meanwhile: what the operator forbids is not flown.
        choice = replace(choice, velocity=mission.guidance.obeyed.nearest(choice.velocity, levels))
        decision_id = uuid.uuid4().hex
        pending = view.pending(mission, decision_id, choice.sensor_id, choice.velocity)
        watch.lap("check")
        answer = DecideResponse(
            decision_id=decision_id,
            mission_id=mission.mission_id,
            uav_id=uav.uav_id,
            step=step,
            sensor_id=choice.sensor_id,
            velocity=choice.velocity,
            source=choice.source,
            reason=choice.reason,
            model=None if choice.reason else choice.model,
            top_k=view.candidates,
            guided=choice.guided,
            tokens=with_usage(tokens, choice.completion, self._settings),
            deadline_ms=turn.deadline_ms,
            latency_ms=watch.total(),
        )
        counsel = None if choice.advice is None else AdviserReport(choice.model or "", choice.advice)
        mission.commit(pending, turn.attempt, counsel)
        mission.bases.hold(uav, step, decision_id)
        self.live.drafted(mission, uav, prompt, answer)
        waited_ms = watch.stages.get("llm", 0.0) + watch.stages.get("plan", 0.0)
        self._own_s += ((answer.latency_ms["total"] - waited_ms) / 1e3 - self._own_s) / _OWN_MEMORY
        return answer

    def _plan(self, mission: Mission, uavs: list[int], step: int, deadline: float) -> asyncio.Task[None] | None:
        """Begin to plan for UAVs of this step, where their mission's mode may need it."""
        if mission.planner is None or mission.mode == "value":
            return None
        left = deadline - RESERVE_S - time.perf_counter()
        # In mode `guided` what comes after it, the LLM's answer mostly, is to have at least as much.
        seconds = min(self._settings.planner_ms / 1e3, left / 2 if mission.mode == "guided" else left)
        taken = mission.reserved(step, uavs[0])
        task = asyncio.create_task(mission.planner.plan(uavs, taken, seconds, self._planning))
        self._plans.add(task)
        task.add_done_callback(self._plans.discard)
        return task

    async def _choose(self, mission: Mission, view: AttendedState, prompt: Prompt, turn: DecisionTask) -> Choice:
        """The LLM's choice or the learned values', as the mission's mode says; the policy's where neither has one."""
        completion: Completion | None = None
        reason: Reason | None = None
        try:
            if mission.mode == "policy":
                raise NoDecision("mode_policy", "nobody else is asked")
            if not view.rows:
                raise NoDecision("no_candidate", "no sensor is both heard and free")
            if mission.mode == "value":
                (sensor, velocity), reason = view.by_value(mission), "mode_value"
            elif not mission.promptable:
                raise NoDecision("llm_unavailable", "its context does not hold the prompt")
            else:
                try:
                    levels = mission.scenario.max_velocity + 1
                    completion = await self.asking.pair(prompt, view.offered, levels, turn.deadline)
                finally:
                    turn.watch.lap("llm")
                sensor, velocity = check_answer(completion.text, view.offered, mission.scenario.max_velocity + 1)
                if not mission.guidance.obeyed.allows(velocity):
                    raise NoDecision("answer_velocity", f"the operator forbids {velocity} m/s")
                verify(mission, view, sensor, velocity)
        except NoDecision as error:
            log.debug("mission %s: %s: %s", mission.mission_id, error.reason, error)
            await _until(turn.plan, turn.deadline)
            turn.watch.lap("plan")
            sensor, velocity = self._by_policy(mission, view)
            reason = error.reason
        if mission.asks and reason != "no_candidate":
            self._metrics.llm_requests.labels(reason or "ok").inc()
        return Choice(sensor, velocity, reason, completion, completion.model if completion else None)

    def _by_policy(self, mission: Mission, view: AttendedState) -> Action:
        """The plan's, or one step of look-ahead where there is no plan."""
        reserved = mission.reserved(view.step, view.uav_id)
        planned = mission.planner.action(view.uav_id, reserved) if mission.planner is not None else None
        if planned is not None:
            return planned
        sensor, velocity = decide_without_llm(view.state, view.uav_id, mission.scenario, reserved, view.asked)
        if sensor in reserved:
            # Every sensor reported is taken: one that was not reported is worth a try, a taken one is not.
            sensor = next((i for i in range(mission.scenario.sensors) if i not in reserved), sensor)
        return Action(sensor, velocity)

    async def _weigh(
        self, mission: Mission, view: AttendedState, deliberation: Deliberation, turn: DecisionTask
    ) -> Choice:
        """Mode ``guided``: the LLM's word weighed with the others' and with the critic, which thinks while it is asked.

        Without a word the others decide: source ``policy``, with the reason; without the critic, the policy.
        """
        thinking = asyncio.get_running_loop().run_in_executor(self._judging, deliberation.judge)
        word = turn.word
        if not mission.promptable:
            word = LlmAdvice(
                deliberation.prompt, None, "llm_unavailable", None, calibrated=False, model=self._llm.model
            )
        try:
            if word is None:
                word = await self.asking.word(mission, deliberation.offer, deliberation.prompt, turn.deadline)
                turn.watch.lap("llm")
            await asyncio.wait({thinking}, timeout=max(0.0, turn.last_moment - time.perf_counter()))
            judgement = thinking.result() if thinking.done() else None
        finally:
            # Nobody waits for it any more: one that is queued is not begun.
            thinking.cancel()
        turn.watch.lap("judge")
        if judgement is None:
            self._metrics.critic_timeouts.inc()
            sensor, velocity = self._by_policy(mission, view)
            return Choice(sensor, velocity, word.reason or "critic_timeout", word.completion, word.model)
        trust = mission.trust_in(word.model)
        gone = mission.reserved(view.step, view.uav_id)
        told = word.of(deliberation.offer.actions)
        verdict = deliberation.conclude(trust, judgement, told, calibrated=word.calibrated, gone=gone)
        if verdict is None:
            sensor, velocity = self._by_policy(mission, view)
            return Choice(sensor, velocity, "answer_reserved", word.completion, word.model)
        self._metrics.llm_trust.observe(trust.weights[LLM])
        # All that it said something of may have been given away.
        reason = word.reason or ("answer_reserved" if told is None else None)
        return Choice(*verdict.action, reason, word.completion, word.model, verdict.told, verdict.advice)


async def _until(plan: asyncio.Task[None] | None, deadline: float) -> None:
    """Wait for a plan, but not past the deadline; what is found later serves the fleet's next decisions."""
    if plan is not None:
        await asyncio.wait({plan}, timeout=max(0.0, deadline - time.perf_counter()))
