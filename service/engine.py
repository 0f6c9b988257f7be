"""The decision pipeline: augment, attend, prompt, ask, check, answer; and feedback, from which the modules learn."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

from service.asking import Asking, Word
from service.compiler import Compiler
from service.guided import LLM, Deliberation, trust_of
from service.learner import Sample
from service.llm.answer import NoDecision, check_answer
from service.llm.client import Completion
from service.llm.upstream import Upstream
from service.metrics import Metrics
from service.mission import Mission
from service.missions import Missions
from service.policy import decide_without_llm
from service.prompt import Prompt
from service.settings import Settings, usable_cores
from service.tokens import TokenCounter, price_usd
from service.trust import Advice
from service.view import View
from shared.wire import (
    BatchRequest,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    Guided,
    Outcome,
    Reason,
    Source,
    Tokens,
    UavState,
)

log = logging.getLogger(__name__)

_SOURCES: dict[Reason | None, Source] = {None: "llm", "mode_value": "value", "mode_policy": "policy"}
# Kept back from the LLM's time for checking, answering and the way through the event loop.
_RESERVE_S = 0.02
# Of a batch's time, the most that the LLM may take which is asked about all of its UAVs at once, and the least that it
# is asked for: what it leaves is for weighing one UAV's candidates after the other's, reckoned twice.
_TOGETHER_MOST, _TOGETHER_LEAST = 0.75, 0.25
# A UAV's own share, seconds, until it is known, and how many decisions it is learned over.
_OWN_S, _OWN_MEMORY = 0.03, 20
# Outcomes waiting to be learned from; with 10 sensors one takes a millisecond, with 10,000 a third of a second.
_MAX_LESSONS = 256


@dataclass(slots=True)
class Stopwatch:
    """Milliseconds by stage since the request came in."""

    started: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """End a stage, or one more part of it."""
        now = time.perf_counter()
        self.stages[stage] = round(self.stages.get(stage, 0.0) + (now - self._last) * 1e3, 3)
        self._last = now

    def total(self) -> dict[str, float]:
        """The stages and their total."""
        return {**self.stages, "total": round((time.perf_counter() - self.started) * 1e3, 3)}


@dataclass(frozen=True, slots=True)
class Turn:
    """One UAV's turn to be told: its attempt at this step, its time, and what has been begun for it.

    ``word`` is there where the LLM has been asked about it already.
    """

    uav: UavState
    step: int
    attempt: int
    deadline_ms: int
    watch: Stopwatch
    plan: asyncio.Task[None] | None
    word: Word | None = None

    @property
    def deadline(self) -> float:
        """When to have checked and answered, of ``time.perf_counter``."""
        return self.watch.started + self.deadline_ms / 1e3 - _RESERVE_S


@dataclass(frozen=True, slots=True)
class Choice:
    """A sensor and a velocity, with the reason where the LLM had no part in them.

    In mode ``guided`` also what the response tells of it, and the advice that trust learns from.
    """

    sensor_id: int
    velocity: int
    reason: Reason | None
    completion: Completion | None
    guided: Guided | None = None
    advice: Advice | None = None

    @property
    def source(self) -> Source:
        """Who decided."""
        return "guided" if self.guided and self.reason is None else _SOURCES.get(self.reason, "policy")


class Engine:
    """Decides for every mission of one service, and learns from what comes back."""

    def __init__(self, settings: Settings, upstream: Upstream, counter: TokenCounter, metrics: Metrics) -> None:
        self._settings = settings
        self._upstream = upstream
        self.asking = Asking(upstream, metrics)
        self.compiler = Compiler(upstream)
        self._counter = counter
        self._metrics = metrics
        self._learning = ThreadPoolExecutor(max_workers=1, thread_name_prefix="learner")
        self._planning = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="planner")
        self._plans: set[asyncio.Task[None]] = set()
        self._own_s = _OWN_S
        self._room = threading.Semaphore(_MAX_LESSONS)
        self.missions = Missions(settings, metrics)

    def close(self) -> None:
        """Finish the lesson and the plans in hand, and drop those that are queued."""
        self._planning.shutdown(wait=True, cancel_futures=True)
        self._learning.shutdown(wait=True, cancel_futures=True)

    async def decide(self, request: DecideRequest, *, may_make: bool = True) -> DecideResponse:
        """One UAV's decision, within its deadline whatever the LLM does; raises ``Refused`` for bad input."""
        watch = Stopwatch()
        mission = self.missions.checked(request, may_make=may_make)
        if request.outcome is not None:
            self._apply(mission, request.outcome)
        deadline_ms = request.deadline_ms or self._settings.deadline_ms
        mission.observe(request, request.step)
        plan = self._plan(mission, [request.uav_id], request.step, watch.started + deadline_ms / 1e3)
        attempt = mission.attempt(request.step, request.uav_id)
        return await self._decide(mission, Turn(request, request.step, attempt, deadline_ms, watch, plan))

    async def decide_batch(self, request: BatchRequest, *, may_make: bool = True) -> list[DecideResponse]:
        """A fleet's decisions in the order asked.

        All that the UAVs report is known before the first decides, and one plan serves them all, until a UAV is told
        something else than it: then the rest is planned again. The LLM is asked about all at once where it can be,
        while the plan is made; else about one after the other. Each UAV has an equal share of the time that is left.
        """
        watch = Stopwatch()
        total_ms = request.deadline_ms or self._settings.deadline_ms
        ends = watch.started + total_ms / 1e3
        answers: list[DecideResponse] = []
        mission = self.missions.checked(request, may_make=may_make)
        # All at once: the first decision may use every outcome, and none can be forgotten while others wait.
        for outcome in (uav.outcome for uav in request.uavs if uav.outcome is not None):
            self._apply(mission, outcome)
        for uav in request.uavs:
            mission.observe(uav, request.step)
        waiting = [uav.uav_id for uav in request.uavs]
        # Before the LLM is asked: a batch that is sent again meanwhile is the later attempt.
        attempts = {uav: mission.attempt(request.step, uav) for uav in waiting}
        plan: asyncio.Task[None] | None = None
        words: dict[int, Word] = {}
        llm_s = min(_TOGETHER_MOST * total_ms / 1e3, total_ms / 1e3 - 2 * len(waiting) * self._own_s)
        enough = llm_s >= _TOGETHER_LEAST * total_ms / 1e3
        if enough and self.asking.may_ask_together(mission, len(waiting)):
            plan = self._plan(mission, waiting, request.step, ends)
            views = [View.of(mission, uav, request.step) for uav in request.uavs]
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
            its = Turn(uav, request.step, attempts[uav.uav_id], deadline_ms, own, plan, word)
            answer = await self._decide(mission, its)
            if mission.planner is None or mission.planner.action(uav.uav_id) != (answer.sensor_id, answer.velocity):
                plan = None
            answers.append(answer)
            await asyncio.sleep(0)
        return answers

    def feedback(self, request: FeedbackRequest) -> FeedbackResponse:
        """Apply an outcome once; raises ``NotFound`` for an unknown mission or decision."""
        mission = self.missions.get(request.mission_id)
        return FeedbackResponse(decision_id=request.decision_id, result=self._apply(mission, request))

    async def _decide(self, mission: Mission, turn: Turn) -> DecideResponse:
        uav, step, watch, word = turn.uav, turn.step, turn.watch, turn.word
        if mission.mode == "guided":
            await _until(turn.plan, turn.deadline)
            watch.lap("plan")
        view = View.of(mission, uav, step)
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
        tokens = self._count(prompt)
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
            model=None if choice.reason else self._upstream.model,
            top_k=view.candidates,
            guided=choice.guided,
            tokens=self._with_usage(tokens, choice.completion),
            deadline_ms=turn.deadline_ms,
            latency_ms=watch.total(),
        )
        mission.commit(pending, turn.attempt)
        if choice.advice is not None:
            trust_of(mission, self._upstream.model).note(decision_id, choice.advice)
        self._metrics.record_decision(answer)
        waited_ms = watch.stages.get("llm", 0.0) + watch.stages.get("plan", 0.0)
        self._own_s += ((answer.latency_ms["total"] - waited_ms) / 1e3 - self._own_s) / _OWN_MEMORY
        return answer

    def _plan(self, mission: Mission, uavs: list[int], step: int, deadline: float) -> asyncio.Task[None] | None:
        """Begin to plan for UAVs of this step, where their mission's mode may need it."""
        if mission.planner is None or mission.mode == "value":
            return None
        left = deadline - _RESERVE_S - time.perf_counter()
        # In mode `guided` what comes after it, the LLM's answer mostly, is to have at least as much.
        seconds = min(self._settings.planner_ms / 1e3, left / 2 if mission.mode == "guided" else left)
        taken = mission.reserved(step, uavs[0])
        task = asyncio.create_task(mission.planner.plan(uavs, taken, seconds, self._planning))
        self._plans.add(task)
        task.add_done_callback(self._plans.discard)
        return task

    async def _choose(self, mission: Mission, view: View, prompt: Prompt, turn: Turn) -> Choice:
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
            else:
                try:
                    levels = mission.scenario.max_velocity + 1
                    completion = await self.asking.pair(prompt, view.offered, levels, turn.deadline)
                finally:
                    turn.watch.lap("llm")
                sensor, velocity = check_answer(completion.text, view.offered, mission.scenario.max_velocity + 1)
                if not mission.guidance.obeyed.allows(velocity):
                    raise NoDecision("answer_velocity", f"the operator forbids {velocity} m/s")
            # Others may have been answered while this one waited.
            if sensor in mission.reserved(view.step, view.uav_id):
                raise NoDecision("answer_reserved", f"sensor {sensor} was given away meanwhile")
        except NoDecision as error:
            log.debug("mission %s: %s: %s", mission.mission_id, error.reason, error)
            await _until(turn.plan, turn.deadline)
            turn.watch.lap("plan")
            sensor, velocity = self._by_policy(mission, view)
            reason = error.reason
        if mission.asks and reason != "no_candidate":
            self._metrics.llm_requests.labels(reason or "ok").inc()
        return Choice(sensor, velocity, reason, completion)

    def _by_policy(self, mission: Mission, view: View) -> tuple[int, int]:
        """The plan's, or one step of look-ahead where there is no plan."""
        reserved = mission.reserved(view.step, view.uav_id)
        planned = mission.planner.action(view.uav_id, reserved) if mission.planner is not None else None
        if planned is not None:
            return planned
        sensor, velocity = decide_without_llm(view.state, view.uav_id, mission.scenario, reserved, view.asked)
        if sensor in reserved:
            # Every sensor reported is taken: one that was not reported is worth a try, a taken one is not.
            sensor = next((i for i in range(mission.scenario.sensors) if i not in reserved), sensor)
        return sensor, velocity

    async def _weigh(self, mission: Mission, view: View, deliberation: Deliberation, turn: Turn) -> Choice:
        """Mode ``guided``: the LLM's word weighed with the others' and with the critic, which thinks while it is asked.

        Without one the others decide: source ``policy``, with the reason.
        """
        thinking = asyncio.create_task(asyncio.to_thread(deliberation.judge))
        word = turn.word
        try:
            if word is None:
                word = await self.asking.word(mission, deliberation.offer, deliberation.prompt, turn.deadline)
                turn.watch.lap("llm")
        finally:
            judgement = await thinking
        turn.watch.lap("judge")
        trust = trust_of(mission, self._upstream.model)
        gone = mission.reserved(view.step, view.uav_id)
        told = word.of(deliberation.offer.actions)
        verdict = deliberation.conclude(trust, judgement, told, calibrated=word.calibrated, gone=gone)
        if verdict is None:
            sensor, velocity = self._by_policy(mission, view)
            return Choice(sensor, velocity, "answer_reserved", word.completion)
        self._metrics.llm_trust.observe(trust.weights[LLM])
        # All that it said something of may have been given away.
        reason = word.reason or ("answer_reserved" if told is None else None)
        return Choice(*verdict.action, reason, word.completion, verdict.told, verdict.advice)

    def _apply(self, mission: Mission, outcome: Outcome) -> Literal["applied", "duplicate"]:
        result: Literal["applied", "duplicate"] = "duplicate"
        if mission.find(outcome.decision_id) == "pending":
            result = "applied"
            if outcome.cost > mission.most_cost:
                # Forged or mistaken: as the worst that can be, it spoils neither the modules nor the prompt.
                self._metrics.costs_clipped.inc()
                outcome = outcome.model_copy(update={"cost": mission.most_cost})
            sample = mission.apply(outcome)
            for trust in mission.trust.values():
                trust.settle(outcome.decision_id, outcome.cost)
            if sample is not None and self._room.acquire(blocking=False):
                self._learning.submit(self._learn, mission, sample, outcome.cost)
            elif sample is not None:
                log.warning("mission %s: learning falls behind, an outcome is not learned from", mission.mission_id)
        self._metrics.feedback.labels(result).inc()
        return result

    def _learn(self, mission: Mission, sample: Sample, cost: float) -> None:
        try:
            self._metrics.learner_loss.set(mission.learner.update(sample, cost))
        except Exception:
            log.exception("mission %s: the learner failed on an outcome; decisions go on", mission.mission_id)
        finally:
            self._room.release()

    def _count(self, prompt: Prompt) -> Tokens:
        static = self._counter.count_repeated(prompt.static)
        experiences = sum(self._counter.count_repeated(line) for line in prompt.experiences.splitlines(keepends=True))
        state = self._counter.count(prompt.state)
        state_uncompressed = self._counter.count(prompt.state_uncompressed)
        return Tokens(
            tokenizer=self._counter.name,
            static=static,
            experiences=experiences,
            state=state,
            state_uncompressed=state_uncompressed,
            prompt=static + experiences + state,
            uncompressed=static + experiences + state_uncompressed,
            saved=state_uncompressed - state,
        )

    def _with_usage(self, tokens: Tokens, completion: Completion | None) -> Tokens:
        if completion is None or completion.prompt_tokens is None:
            return tokens
        cached = completion.cached_tokens or 0
        cost = price_usd(self._settings, completion.prompt_tokens, cached, completion.completion_tokens or 0)
        usage = {
            "server_prompt": completion.prompt_tokens,
            "cached": completion.cached_tokens,
            "completion": completion.completion_tokens,
            "cost_usd": cost,
        }
        return tokens.model_copy(update=usage)


async def _until(plan: asyncio.Task[None] | None, deadline: float) -> None:
    """Wait for a plan, but not past the deadline; what is found later serves the fleet's next decisions."""
    if plan is not None:
        await asyncio.wait({plan}, timeout=max(0.0, deadline - time.perf_counter()))
