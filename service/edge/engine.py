"""One edge: it resolves a request's mission, decides, makes the answer durable, and reports it."""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable
from functools import partial

from pydantic import TypeAdapter
from structlog.contextvars import bind_contextvars, clear_contextvars

from service.config.settings import Settings
from service.deciding.decision_task import RESERVE_S, DecisionTask
from service.deciding.llm_query import LlmQueries
from service.deciding.pipeline import Pipeline, RecordedDecision
from service.deciding.stopwatch import Deadline, Stopwatch
from service.edge.batch import BatchDecider
from service.edge.feedback import Feedback
from service.edge.mission_registry import MissionRegistry
from service.errors import Unavailable
from service.guidance.note_compiler import NoteCompiler
from service.learning.trust import LLM
from service.live.broadcaster import Broadcaster
from service.llm.server_pool import ServerPool
from service.mission.mission import Mission
from service.observability import logs
from service.observability.metrics import Metrics
from service.observability.tracing import Traces
from service.prompting.token_accounting import TokenCounter, with_usage
from service.storage.journal import Journal, NullJournal
from service.storage.store import Store
from shared.wire.readings import ReadingsRequest, ReadingsResponse
from shared.wire.reasons import Reason
from shared.wire.schemas import BatchRequest, DecideRequest, DecideResponse, FeedbackRequest, FeedbackResponse, Source

# The longest wait of an answer for the disk; after that it is sent with `stored` false.
STORE_S = 1.0
# Seconds for the last checkpoints, and for the last commit, when the service ends.
_LAST_CHECKPOINTS_S, _LAST_COMMIT_S = 2.0, 2.5
_ANSWERS = TypeAdapter(list[DecideResponse])
# The decider's name in the response, where it is not the LLM-free policy or mode `guided`.
_SOURCES: dict[Reason | None, Source] = {None: "llm", "mode_value": "value"}


class Engine:
    """Decides for every mission of one service, and learns from the outcomes."""

    def __init__(
        self,
        settings: Settings,
        llm: ServerPool,
        counter: TokenCounter,
        metrics: Metrics,
        traces: Traces,
        store: Store | None,
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._traces = traces
        self.live = Broadcaster()
        self.compiler = NoteCompiler(llm, self.live.changed)
        self.queries = LlmQueries(llm, metrics, settings.llm_concurrency)
        self.pipeline = Pipeline(settings, self.queries, counter)
        self._batches = BatchDecider(self.pipeline, self.queries)
        self.journal: Journal | NullJournal = NullJournal() if store is None else Journal(store, metrics)
        self.journal.on_recovery = self._recovered
        self._feedback = Feedback(metrics, self.journal, self.live)
        self.missions = MissionRegistry(settings, metrics, self.journal, store, self._loaded, self.live.forget)

    def _loaded(self, mission: Mission) -> None:
        self.live.watch.restored(mission)
        self.compiler.compile(mission)

    def _recovered(self) -> None:
        self._recovery = asyncio.create_task(self._feedback.checkpoint_all(self.missions.loaded, math.inf))

    def hurry(self) -> None:
        """Prepare to close: queries to the LLM end within seconds, and pages get no more updates."""
        self.queries.hurry()
        self.live.close()

    async def close(self) -> bool:
        """Finish the work in progress, learn from every outcome, and write the last checkpoints.

        Returns:
            whether the store may be closed: False while an abandoned write still uses it.
        """
        self.live.close()
        await self.compiler.close()
        await self.queries.close()
        self._feedback.finish()
        await self.pipeline.close()
        self.missions.close()
        await self._feedback.checkpoint_all(self.missions.loaded, _LAST_CHECKPOINTS_S)
        ended = await self.journal.close(_LAST_COMMIT_S)
        if ended:
            await self.missions.release()
        return ended

    async def decide(self, request: DecideRequest, *, may_make: bool = True, key: str | None = None) -> DecideResponse:
        """One UAV's decision, within its deadline whatever the LLM does.

        Args:
            may_make: whether a mission that does not exist yet may be made.
            key: an idempotency key; a repeated request under it gets the same answer.

        Raises:
            Refused: the request does not fit its mission.
            NotFound, Conflict, Misdirected, Unavailable: as :meth:`MissionRegistry.resolve`.
        """
        watch, deadline = self._start(request)
        mission, report = await self.missions.resolve(request, may_make=may_make, key=key, deadline=deadline)
        make = partial(self._decide_one, mission, report, watch, deadline)
        return (await self._respond(mission, request, key, make, deadline))[0]

    async def decide_batch(
        self, request: BatchRequest, *, may_make: bool = True, key: str | None = None
    ) -> list[DecideResponse]:
        """A fleet's decisions at one step in the order of its UAVs; arguments and errors as for :meth:`decide`."""
        watch, deadline = self._start(request)
        mission, reports = await self.missions.resolve(request, may_make=may_make, key=key, deadline=deadline)

        async def make() -> list[RecordedDecision]:
            self._feedback.catch_up(mission)
            # All outcomes are applied before the first decision, so that none is lost while the UAVs wait for the LLM.
            for outcome in (uav.outcome for uav in reports.uavs if uav.outcome is not None):
                self._feedback.apply_reported(mission, outcome)
            mission.end_orders(request.step)
            return await self._batches.decide(mission, reports, watch, deadline)

        return await self._respond(mission, request, key, make, deadline)

    async def feedback(
        self, request: FeedbackRequest, may_know: Callable[[str], bool] = lambda _: True
    ) -> FeedbackResponse:
        """Apply an outcome once; an acknowledged outcome is on disk.

        Args:
            may_know: whether a mission may be looked at for the decision of a request without a mission.

        Raises:
            NotFound: an unknown mission or decision.
            Conflict: another outcome of the decision is applied already.
            Unavailable: the store fails, or is slow; the client is to send the outcome again.
        """
        if request.mission_id is None:
            mission = await self.missions.of_decision(request.decision_id, may_know)
        else:
            mission = await self.missions.get(request.mission_id)
        self.missions.refuse_if_failing("decision_id")
        result = self._feedback.apply(mission, request)
        try:
            await self.durable("decision_id", mission)
        finally:
            asyncio.get_running_loop().call_soon(self._feedback.follow_up, mission)
        return FeedbackResponse(decision_id=request.decision_id, result=result)

    async def read(self, mission_id: str, request: ReadingsRequest) -> ReadingsResponse:
        """Merge sensors' own readings; acknowledged readings are on disk.

        Raises:
            NotFound: there is no such mission.
            Refused: as :meth:`Readings.placed`; nothing is recorded.
            Unavailable: the store fails, or is slow; the client is to send the readings again.
        """
        mission = await self.missions.get(mission_id)
        self.missions.refuse_if_failing("readings")
        results = mission.read(request.readings)
        self.live.changed(mission_id)
        self._metrics.record_readings(results)
        try:
            # A duplicate's first sending may be on no disk yet.
            await self.durable("readings", mission)
        finally:
            asyncio.get_running_loop().call_soon(self._feedback.follow_up, mission)
        return ReadingsResponse(results=results, step=mission.belief.newest)

    async def delete(self, mission_id: str) -> None:
        """Delete a mission; raises as :meth:`MissionRegistry.delete`."""
        epoch: int | None = None
        try:
            epoch = await self.missions.delete(mission_id)
            self.live.forget(mission_id)
        finally:
            # A mission that is already deleted may still be on disk.
            await self._on_disk("mission_id")
        if self.journal.lost_epoch(mission_id, epoch):
            raise _taken_over()

    async def durable(self, field: str, mission: Mission) -> None:
        """Wait until every event of the mission so far is on disk.

        Raises:
            Unavailable: the wait times out, or another edge has taken over the mission.
        """
        await self._on_disk(field)
        if self.journal.lost(mission):
            raise _taken_over()

    async def _on_disk(self, field: str) -> None:
        if not await self.journal.stored(STORE_S):
            raise Unavailable(field, "not on disk yet: send it again to be sure")

    def _start(self, request: DecideRequest | BatchRequest) -> tuple[Stopwatch, Deadline]:
        watch = Stopwatch()
        clear_contextvars()
        # Every log line of the request has these fields.
        bind_contextvars(mission_id=request.mission_id, step=request.step)
        return watch, Deadline(watch.started + (request.deadline_ms or self._settings.deadline_ms) / 1e3)

    async def _decide_one(
        self, mission: Mission, request: DecideRequest, watch: Stopwatch, deadline: Deadline
    ) -> list[RecordedDecision]:
        self._feedback.catch_up(mission)
        if request.outcome is not None:
            self._feedback.apply_reported(mission, request.outcome)
        mission.end_orders(request.step)
        attempt = mission.observe(request, request.step)
        deadline_ms, mine = request.deadline_ms or self._settings.deadline_ms, Deadline(deadline.at - RESERVE_S)
        plan = self.pipeline.begin_plan(mission, [request.uav_id], request.step, mine)
        task = DecisionTask(mission, request, request.step, attempt, deadline_ms, mine, mine, watch, plan)
        return [await self.pipeline.decide_one(task)]

    async def _respond(
        self,
        mission: Mission,
        request: DecideRequest | BatchRequest,
        key: str | None,
        make: Callable[[], Awaitable[list[RecordedDecision]]],
        deadline: Deadline,
    ) -> list[DecideResponse]:
        """The answers, remembered or new, once they are on disk or the wait for it has timed out."""
        decisions: list[RecordedDecision] = []
        answers: list[DecideResponse] = []
        try:
            if key is None:
                decisions = await make()
                answers = [_answer(decided, self._settings) for decided in decisions]
            else:
                decisions, answers = await self._once(mission, request, key, make)
            began = time.perf_counter()
            stored = await self.journal.stored(min(STORE_S, deadline.at - began))
            if self.journal.lost(mission):
                raise _taken_over()
            waited_ms = round((time.perf_counter() - began) * 1e3, 3)
            for index, answer in enumerate(answers):
                total = round(answer.latency_ms["total"] + waited_ms, 3)
                latency = {**answer.latency_ms, "store": waited_ms, "total": total}
                answers[index] = answer.model_copy(update={"stored": stored, "latency_ms": latency})
            return answers
        finally:
            # The event loop sends the answer first.
            asyncio.get_running_loop().call_soon(self._follow_up, mission, decisions, answers)

    async def _once(
        self,
        mission: Mission,
        request: DecideRequest | BatchRequest,
        key: str,
        make: Callable[[], Awaitable[list[RecordedDecision]]],
    ) -> tuple[list[RecordedDecision], list[DecideResponse]]:
        """The decisions made now, if any, and the answers under an idempotency key."""
        decisions: list[RecordedDecision] = []
        answers: list[DecideResponse] = []

        async def made() -> str:
            decisions.extend(await make())
            answers.extend(_answer(decided, self._settings) for decided in decisions)
            # The journal records the answer under its key in the same commit as the decision.
            return _ANSWERS.dump_json(answers).decode()

        text = await mission.idempotent_answers.once(key, request, made, mission.record)
        return decisions, answers or _ANSWERS.validate_json(text)

    def _follow_up(self, mission: Mission, decisions: list[RecordedDecision], answers: list[DecideResponse]) -> None:
        """Report a request whose answer is sent, and write a checkpoint if one is due."""
        self._feedback.follow_up(mission)
        for decided, answer in zip(decisions, answers, strict=False):
            self._report(decided, answer)

    def _report(self, decided: RecordedDecision, answer: DecideResponse) -> None:
        """Report an answer to metrics, traces, the log and the mission page."""
        task, choice = decided.task, decided.choice
        trace_id = self._traces.decided(answer)
        self._metrics.record_decision(answer, trace_id)
        if (measured := task.mission.measured.pop(task.uav.uav_id, None)) is not None:
            self._metrics.record_measured(measured)
        self._metrics.overflow_risk.observe(decided.state.state.overflow_risk)
        # Queries for letters count themselves.
        if (task.mission.mode, task.mission.spec.prompt.format) == ("llm", "csv") and choice.reason != "no_candidate":
            self._metrics.llm_requests.labels(choice.reason or "ok").inc()
        if choice.unevaluated:
            self._metrics.evaluator_timeouts.inc()
        if choice.report is not None:
            self._metrics.llm_trust.observe(choice.report.trust[LLM])
        logs.decided(answer, trace_id)
        self.live.decided(task.mission, task.uav, decided.prompt, answer)


def _taken_over() -> Unavailable:
    return Unavailable("mission_id", "another edge has taken over the mission, nothing was recorded: send it again")


def _answer(decided: RecordedDecision, settings: Settings) -> DecideResponse:
    """The wire's form of a decision."""
    task, choice = decided.task, decided.choice
    return DecideResponse(
        decision_id=decided.decision_id,
        mission_id=task.mission.mission_id,
        uav_id=task.uav.uav_id,
        step=task.step,
        sensor_id=choice.action.sensor_id,
        velocity=choice.action.velocity,
        source="guided" if choice.report and choice.reason is None else _SOURCES.get(choice.reason, "policy"),
        reason=choice.reason,
        model=None if choice.reason else choice.model,
        top_k=decided.state.candidates,
        guided=choice.report,
        tokens=with_usage(decided.tokens, choice.completion, settings),
        deadline_ms=task.deadline_ms,
        latency_ms=decided.latency_ms,
    )
