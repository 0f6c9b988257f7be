"""One LLM server: its life cycle, its health, and the calls that the edge makes to it."""

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import Context
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from service.config.settings import Settings
from service.llm.adapter_version import AdapterUnusable
from service.llm.answers import Busy, Completion, NoDecision, NotUnderstood, Unreachable, raised
from service.llm.connection import PROBE_TIMEOUT_S, Connection
from service.llm.embedded import Embed, LoadFailed, embedded
from service.llm.model_file import ModelMissing
from service.llm.request_bodies import (
    SEVERAL_LABELS_TEMPERATURE,
    Rewriting,
    WarmUp,
    chat_body,
    label_body,
    rewriting_body,
)
from service.llm.usability import CircuitBreaker, SilenceCounter, Usability
from shared.wire.reasons import Reason
from shared.wire.schemas import LLM_MODES, Readiness

# How often a request is cancelled for a decision, the quiet time that it waits for, and how long it waits at most. Each
# request evicts the other kind's prefix from the cache. In a mission, decisions come seconds apart.
_MOST_CANCELLATIONS = 3
SILENCE_S = 0.5
_PATIENCE_S = 10.0
log = logging.getLogger(__name__)
RETRY_S = 5.0
# A probe that fails within this time costs next to nothing: gateways refuse it while the server behind them starts.
_AT_ONCE_S = 1.0
# Message to a call that is cancelled because an earlier call was answered, which is no failure of this server.
EARLIER_CALL_ANSWERED = "another answered"


class DecisionPriority:
    """The decisions in progress at a server, and the background request that they may cancel."""

    def __init__(self) -> None:
        self._decisions = 0
        self._decided_at = -math.inf
        self._background: asyncio.Task[Completion] | None = None

    @contextmanager
    def decision(self) -> Iterator[None]:
        """The time of a request for a decision, which cancels the background request."""
        self._decisions += 1
        if self._background is not None:
            self._background.cancel()
        try:
            yield
        finally:
            self._decisions -= 1
            self._decided_at = time.monotonic()

    async def answer(self, ask: Callable[[], Awaitable[Completion]]) -> Completion:
        """The answer of a background request. Decisions cancel it up to three times; each time it starts again."""

        async def once() -> Completion:
            return await ask()

        for _ in range(_MOST_CANCELLATIONS):
            await self._await_silence()
            self._background = asyncio.create_task(once(), name="llm-rewriting")
            try:
                await asyncio.wait({self._background})
            finally:
                self._background.cancel()
            if not self._background.cancelled():
                return self._background.result()
        return await ask()

    async def _await_silence(self) -> None:
        """Wait until no decision has been requested for ``SILENCE_S``, at most ``_PATIENCE_S``."""
        started = time.monotonic()
        while (now := time.monotonic()) < started + _PATIENCE_S:
            if not self._decisions and now - max(started, self._decided_at) >= SILENCE_S:
                return
            await asyncio.sleep(min(0.1, SILENCE_S))


@dataclass(slots=True)
class ServerStatus:
    """The state of a server's LLM, why it is not ready, and whether the circuit breaker is open."""

    llm: Literal["loading", "ready", "unavailable", "off"]
    detail: str | None = None
    breaker_open: bool = False


class LlmServer:
    """Starts an LLM in the background, calls it, and tries again while it is unavailable.

    ``/healthz`` and decisions by the policy go on meanwhile. The states are ``loading``, ``ready``, ``unavailable``
    with the reason in ``detail``, and ``off`` in a mode without LLM. A server that fails again and again is
    ``unavailable`` too, until a probe is answered: see :mod:`service.llm.usability`.

    Args:
        warm_up: the first request to a server.
        on_open: called when the circuit breaker opens.
        embed: returns the embedded LLM; by default it loads one.

    Attributes:
        status: replaced as a whole when the state changes.
        usability: whether its answers can be used.
        url: the server's address; empty for the embedded LLM.
        connection: to the LLM, with its model's names and its abilities.
    """

    def __init__(
        self, settings: Settings, warm_up: WarmUp, on_open: Callable[[], None] = lambda: None, embed: Embed = embedded
    ) -> None:
        self._settings = settings
        self._on_open = on_open
        self.url = settings.llm_url or ""
        loading = ServerStatus("loading", f"{self.url or 'the embedded LLM'} has not answered yet")
        self.status = ServerStatus("off") if settings.mode in ("value", "policy") else loading
        self.connection = Connection(settings, warm_up, embed)
        # Brings the server up, or waits for its recovery.
        self._task: asyncio.Task[None] | None = None
        self._busy: Busy | None = None
        self.usability = Usability(self._probe_again)
        self._breaker = CircuitBreaker()
        self._silence = SilenceCounter(settings.deadline_ms / 2e3)
        self._priority = DecisionPriority()

    @property
    def recovering(self) -> bool:
        """Whether an LLM that is not ready may become ready without a restart."""
        return self._task is not None and not self._task.done()

    @property
    def paused(self) -> bool:
        """Whether the server asks for no requests at present."""
        return self._busy is not None and self._busy.pause_s > 0.0

    def readiness(self) -> Readiness:
        """The answer of ``/readyz``."""
        ready, connection = self.status.llm == "ready", self.connection
        return Readiness(
            ready=True,
            decides=self._settings.mode if ready or self._settings.mode not in LLM_MODES else "policy",
            llm="degraded" if ready and self.usability.degraded else self.status.llm,
            model=connection.model,
            constraint=connection.abilities.constraint if ready else None,
            abilities=str(connection) if ready else None,
            decision_ms=round(connection.decision_s * 1e3, 1) if ready and connection.decision_s else None,
            detail=self.usability.degraded if ready else self.status.detail,
        )

    def start(self) -> None:
        """Begin to load or reach the LLM, unless it is off."""
        if self.status.llm != "off":
            self._task = asyncio.create_task(self._bring_up(), name="llm-bring-up", context=Context())

    async def close(self) -> None:
        """Stop trying, close the connections, and free the embedded model."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await self.usability.close()
        await self.connection.close()

    async def ask(self, mission_id: str, system: str, user: str, sensor_ids: list[int], velocities: int) -> Completion:
        """Call for one decision's sensor and velocity; the caller sets the time limit.

        Raises:
            NoDecision: no answer, with the reason.
        """
        body = chat_body(
            self.connection.model, system, user, self.connection.abilities.constraint, sensor_ids, velocities
        )
        return await self._decide(mission_id, body, self._silence)

    async def ask_labels(self, mission_id: str, system: str, user: str, lists: Sequence[Sequence[str]]) -> Completion:
        """Call for one label of each list, with the likeliest tokens' probabilities where the server gives them.

        Raises:
            NoDecision: no answer, with the reason.
        """
        body = label_body(
            self.connection.model,
            system,
            user,
            self.connection.abilities.constraint,
            lists,
            self.connection.abilities.logprobs,
        )
        # The silence of a call for several UAVs says nothing about calls for one.
        answer = await self._decide(mission_id, body, self._silence if len(lists) == 1 else None)
        if self.connection.abilities.logprobs != "sampled" or len(lists) == 1:
            return answer
        plain = [replace(p, likeliest=raised(p.likeliest, SEVERAL_LABELS_TEMPERATURE)) for p in answer.positions]
        return replace(answer, positions=tuple(plain))

    async def rewrite(self, wanted: Rewriting, *, temperature: float, seed: int) -> Completion:
        """Call for a rewritten text.

        The embedded model has one slot: decisions cancel the call up to three times, and it starts again.

        Raises:
            ValueError: ``wanted.constrain`` finds nothing to rewrite.
            NoDecision: no answer, with the reason.
        """
        body = rewriting_body(
            self.connection.model, wanted, wanted.constrain(self.connection.abilities.constraint), temperature, seed
        )
        ask = partial(self._complete, partial(self.connection.complete_note, body))
        return await self._priority.answer(ask) if self.connection.embedded else await ask()

    async def _decide(self, mission_id: str, body: dict[str, Any], silence: SilenceCounter | None) -> Completion:
        """Call for a decision, and count its result; ``silence`` counts the wait of a cancelled call."""
        started = time.monotonic()
        try:
            with self._priority.decision():
                answer = await self._complete(partial(self.connection.complete, body, mission_id))
        except NoDecision as error:
            error.url = self.url
            # Of the others the fault is the request's, or will be over by itself.
            if not isinstance(error, NotUnderstood | Busy):
                self._failed(error.reason, f" ({error})")
            raise
        except asyncio.CancelledError as cancelled:
            if silence is None or EARLIER_CALL_ANSWERED in cancelled.args:
                raise
            if silence.cancelled(started, time.monotonic()):
                self._failed("llm_timeout")
            raise
        if self._breaker.troubled:
            self._breaker.answered()
        self._silence.answered_at = time.monotonic()
        return answer

    async def _complete(self, request: Callable[[], Awaitable[Completion]]) -> Completion:
        if self.status.llm != "ready":
            raise NoDecision("llm_loading" if self.status.llm == "loading" else "llm_unavailable", self.status.llm)
        if self._busy is not None and self.paused:
            raise Busy(str(self._busy), self._busy.until)
        try:
            return await request()
        except Busy as busy:
            self._busy = busy
            raise
        except Unreachable as gone:
            if self.status.llm == "ready":
                self.status = ServerStatus("unavailable", str(gone))
                self.start()
            raise

    def _failed(self, reason: Reason, said: str = "") -> None:
        if self.status.llm != "ready" or not self._breaker.failed():
            return
        detail = f"failed too often, the last time by {reason}{said}: no calls for {self._breaker.pause_s:g} s"
        self.status = ServerStatus("unavailable", detail, breaker_open=True)
        log.warning("LLM %s", detail)
        self._on_open()
        self._task = asyncio.create_task(self._recover(), name="llm-recovery", context=Context())

    async def _recover(self) -> None:
        """After the breaker has opened: pause and probe, until a probe is answered."""
        pause_s = self._breaker.pause_s
        while True:
            await asyncio.sleep(pause_s)
            started = time.monotonic()
            try:
                await self.connection.ping()
            except (NotUnderstood, Unreachable) as error:
                # It may have another model now, or after its restart.
                self.status = ServerStatus("unavailable", str(error))
                self.start()
                return
            except Exception as error:
                if time.monotonic() - started > _AT_ONCE_S:
                    self._breaker.failed()
                pause_s = max(self._breaker.pause_s, error.pause_s if isinstance(error, Busy) else 0.0)
                failed = f"still fails, next try in {pause_s:.3g} s: {error}"
                self.status = ServerStatus("unavailable", failed, breaker_open=True)
                log.warning("LLM %s", failed)
            else:
                self.status = ServerStatus("ready")
                log.info("LLM answers again: %s", self.connection.model)
                return

    async def _bring_up(self) -> None:
        while True:
            try:
                await self.connection.open()
                self.status = ServerStatus("ready")
                log.info("LLM ready: %s, %s", self.connection.model, self.connection)
                return
            except (ModelMissing, AdapterUnusable, LoadFailed) as error:
                self.status = ServerStatus("unavailable", str(error))
                log.error("no embedded LLM: %s", error)
                return
            except (NoDecision, TimeoutError) as error:
                self.status = ServerStatus("unavailable", str(error) or f"no answer in {PROBE_TIMEOUT_S:g} s")
                pause_s = max(RETRY_S, error.pause_s if isinstance(error, Busy) else 0.0)
                log.warning("LLM not ready, next try in %.3g s: %s", pause_s, self.status.detail)
            except Exception as error:
                self.status = ServerStatus("unavailable", f"{type(error).__name__}: see the log")
                log.exception("LLM not ready, next try in %g s", pause_s := RETRY_S)
            await asyncio.sleep(pause_s)

    async def _probe_again(self) -> None:
        """Probe a ready server whose answers cannot be used: it may have another model now."""
        if self.status.llm != "ready":
            raise NoDecision("llm_unavailable", self.status.llm)
        await self.connection.probe_again()
