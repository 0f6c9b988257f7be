"""The LLM that this edge asks: which one, whether it is ready, and how it can be held to the answer's form."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable, Sequence
from contextvars import Context
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from service.config.settings import Settings
from service.llm.answer_format import Constraint, NoDecision
from service.llm.circuit_breaker import CircuitBreaker
from service.llm.completion import Completion, NotUnderstood, Unreachable
from service.llm.embedded import EmbeddedServer, LoadFailed
from service.llm.model_file import ModelMissing, embedded_model
from service.llm.probing import probe, probe_body
from service.llm.request_bodies import (
    Rewriting,
    WarmUp,
    chat_body,
    draw_temperature,
    label_body,
    rewriting_body,
    warm_up_body,
)
from shared.reasons import Reason
from shared.wire import Readiness

if TYPE_CHECKING:
    from service.llm.client import LLMClient

log = logging.getLogger(__name__)

_RETRY_S = 5.0
# Said to a call that is hung up because another server, asked before, has answered: that is no fault of this one.
LOST = "another answered"
_PROBE_TIMEOUT_S = 60.0
# What is no decision gives way to one so often, and waits so long for so much silence between them: each spoils the
# other's prefix cache. In a mission decisions come seconds apart.
_STEPS_BACK = 3
_SILENCE_S = 0.5
_PATIENCE_S = 10.0


@dataclass(slots=True)
class _Status:
    llm: Literal["loading", "ready", "unavailable", "off"]
    detail: str | None = None
    # Whether the circuit breaker is open.
    breaker_open: bool = False


class LlmServer:
    """Brings the LLM up in the background and keeps trying while a remote one is down.

    ``/healthz`` and decisions by the policy go on meanwhile. States: ``loading``, ``ready``, ``unavailable``
    (with the reason in ``detail``), and ``off`` where the service was told to do without. A server that fails again and
    again is ``unavailable`` too, until a probe finds it well: see :mod:`service.llm.circuit_breaker`; ``on_open`` hears
    of it.
    """

    def __init__(self, settings: Settings, warm_up: WarmUp, on_open: Callable[[], None] = lambda: None) -> None:
        self._settings = settings
        self._warm_up = warm_up
        self._on_open = on_open
        self._breaker = CircuitBreaker()
        self._answered_at = self._counted_at = -math.inf
        self._waited_s = 0.0
        self._status = _Status("off" if settings.mode in ("value", "policy") else "loading")
        self._client: LLMClient | None = None
        self._embedded: EmbeddedServer | None = None
        self._task: asyncio.Task[None] | None = None
        self.model = settings.llm_model
        self.constraint: Constraint = "none"
        # Whether the server tells the probabilities of tokens.
        self.logprobs = False
        # UAVs that it may be asked about at once.
        self.most_together = 1
        self._deciding = 0
        self._decided_at = -math.inf
        self._beside: asyncio.Task[Completion] | None = None

    @property
    def status(self) -> Literal["loading", "ready", "unavailable", "off"]:
        """Where the LLM stands."""
        return self._status.llm

    @property
    def breaker_open(self) -> bool:
        """Whether its circuit breaker is open."""
        return self._status.breaker_open

    def readiness(self) -> Readiness:
        """What ``/readyz`` says."""
        ready = self.status == "ready"
        return Readiness(
            ready=True,
            decides=self._settings.mode if ready else "policy",
            llm=self.status,
            model=self.model,
            constraint=self.constraint if ready else None,
            detail=self._status.detail,
        )

    def start(self) -> None:
        """Begin loading or probing, unless the LLM is off."""
        if self.status != "off":
            self._task = asyncio.create_task(self._bring_up(), name="llm-bring-up", context=Context())

    @property
    def recovering(self) -> bool:
        """Whether an LLM that is not ready may yet be, without anybody's doing."""
        return self._task is not None and not self._task.done()

    async def close(self) -> None:
        """Stop trying, close connections, free the embedded model."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        if self._client is not None:
            await self._client.close()
        if self._embedded is not None:
            await asyncio.to_thread(self._embedded.close)

    async def ask(self, system: str, user: str, sensor_ids: list[int], velocities: int) -> Completion:
        """One decision's completion; the caller sets the time limit.

        Raises:
            NoDecision: no answer, with the reason.
        """
        return await self._decide(chat_body(self.model, system, user, self.constraint, sensor_ids, velocities))

    async def ask_labels(self, system: str, user: str, lists: Sequence[Sequence[str]]) -> Completion:
        """A token a list that should be a label, with the likeliest tokens' probabilities where the server tells them.

        Raises:
            NoDecision: no answer, with the reason.
        """
        body = label_body(self.model, system, user, self.constraint, lists, self.logprobs)
        # Silence to a question about several UAVs says nothing of how questions about one fare.
        answer = await self._decide(body, patient=len(lists) > 1)
        if self.constraint != "grammar" or (temperature := draw_temperature(lists)) == 1.0:
            return answer
        return replace(answer, places=tuple(place.untempered(temperature) for place in answer.places))

    async def rewrite(self, wanted: Rewriting, *, temperature: float, seed: int) -> str:
        """A text rewritten as told, in a form that the server is held to where it can be.

        The embedded model has one slot: a decision that asks it meanwhile goes first, a few times.

        Raises:
            ValueError: ``wanted.constrain`` finds nothing to ask about.
            NoDecision: no answer, with the reason.
        """
        held = wanted.constrain(self.constraint)
        body = rewriting_body(self.model, wanted.instruction, wanted.examples, wanted.text, held, temperature, seed)
        for _ in range(_STEPS_BACK if self._embedded is not None else 0):
            await self._silence()
            self._beside = asyncio.create_task(self._ask(body), name="ask-beside")
            try:
                await asyncio.wait({self._beside})
            finally:
                self._beside.cancel()
            if not self._beside.cancelled():
                return self._beside.result().text
        return (await self._ask(body)).text

    async def _decide(self, body: dict[str, Any], *, patient: bool = False) -> Completion:
        """Ask for a decision: what is asked beside is given up for it. To be ``patient`` is not to count silence."""
        self._deciding += 1
        if self._beside is not None:
            self._beside.cancel()
        begun = time.monotonic()
        try:
            answer = await self._ask(body)
        except NotUnderstood:
            # That says something of this request, and nothing of the server.
            raise
        except NoDecision as error:
            self._failed(error.reason)
            raise
        except asyncio.CancelledError as hung_up:
            if not patient and LOST not in hung_up.args:
                self._in_vain(begun)
            raise
        else:
            self._breaker.answered()
            self._answered_at, self._waited_s = time.monotonic(), 0.0
            return answer
        finally:
            self._deciding -= 1
            self._decided_at = time.monotonic()

    def _in_vain(self, begun: float) -> None:
        """Count silence: half of a deadline of it, with no answer between, is one failure.

        Who has hardly waited, by a short deadline or in a fleet that shares one, counts for as long as he waited.
        Several who waited side by side count once; who waited while another was answered stood in a queue.
        """
        if self._answered_at > begun:
            return
        now = time.monotonic()
        self._waited_s += now - max(begun, self._counted_at)
        self._counted_at = now
        if self._waited_s >= self._settings.deadline_ms / 2e3:
            self._waited_s = 0.0
            self._failed("llm_timeout")

    def _failed(self, reason: Reason) -> None:
        if self.status != "ready" or not self._breaker.failed():
            return
        pause_s = self._breaker.pause_s
        detail = f"failed too often, the last time by {reason}: left alone {pause_s:g} s"
        self._status = _Status("unavailable", detail, breaker_open=True)
        log.warning("LLM %s", self._status.detail)
        self._on_open()
        self._task = asyncio.create_task(self._recover(), name="llm-recovery", context=Context())

    async def _silence(self) -> None:
        """Wait until no decision has been asked for a while, but not for ever."""
        begun = time.monotonic()
        while (now := time.monotonic()) < begun + _PATIENCE_S:
            if not self._deciding and now - max(begun, self._decided_at) >= _SILENCE_S:
                return
            await asyncio.sleep(min(0.1, _SILENCE_S))

    async def _ask(self, body: dict[str, Any]) -> Completion:
        if self._client is None or self.status != "ready":
            raise NoDecision("llm_loading" if self.status == "loading" else "llm_unavailable", self.status)
        try:
            return await self._client.complete(body)
        except Unreachable as gone:
            if self.status == "ready":
                self._status = _Status("unavailable", str(gone))
                self.start()
            raise

    async def _recover(self) -> None:
        """After the breaker opened: pause, ask one short question, and so on until it is answered."""
        while self._client is not None:
            await asyncio.sleep(self._breaker.pause_s)
            try:
                async with asyncio.timeout(_PROBE_TIMEOUT_S):
                    await self._client.complete(probe_body(self.model, self.constraint))
            except (NoDecision, TimeoutError) as error:
                self._breaker.failed()
                log.warning("LLM still fails, next try in %g s: %s", self._breaker.pause_s, error)
            else:
                self._status = _Status("ready")
                log.info("LLM answers again: %s", self.model)
                return

    async def _bring_up(self) -> None:
        while True:
            try:
                client = await self._connect()
                self._status = _Status("ready")
                log.info("LLM ready: %s at %s, constraint %s", self.model, client.base_url, self.constraint)
                return
            except (ModelMissing, LoadFailed) as error:
                self._status = _Status("unavailable", str(error))
                log.error("no embedded LLM: %s", error)
                return
            except (NoDecision, TimeoutError) as error:
                self._status = _Status("unavailable", str(error) or f"no answer in {_PROBE_TIMEOUT_S:g} s")
                log.warning("LLM not ready, next try in %g s: %s", _RETRY_S, self._status.detail)
            except Exception as error:
                self._status = _Status("unavailable", f"{type(error).__name__}: see the log")
                log.exception("LLM not ready, next try in %g s", _RETRY_S)
            await asyncio.sleep(_RETRY_S)

    async def _connect(self) -> LLMClient:
        """Reach the server, learn what it obeys, and have it read the static block before a decision pays for it."""
        settings, http = self._settings, await asyncio.to_thread(_http)
        if self._client is None and settings.llm_url is not None:
            key = settings.llm_api_key.get_secret_value() if settings.llm_api_key else None
            self._client = http(settings.llm_url, api_key=key)
        elif self._client is None:
            gguf = embedded_model(settings)
            self._embedded = await asyncio.to_thread(
                EmbeddedServer, gguf, threads=settings.embedded_threads, context=settings.llm_context
            )
            self._client = http(self._embedded.base_url, api_key=self._embedded.api_key, trust_env=False)
            self.model = self.model or self._embedded.model
        async with asyncio.timeout(_PROBE_TIMEOUT_S):
            if self.model is None:
                self.model = next(iter(await self._client.models()), None)
            able = await probe(self._client, self.model)
            self.constraint, self.logprobs, self.most_together = able.constraint, able.logprobs, able.most_together
        try:
            async with asyncio.timeout(_PROBE_TIMEOUT_S):
                await self._client.complete(warm_up_body(self.model, self._warm_up, self.constraint, self.logprobs))
        except (NoDecision, TimeoutError) as error:
            log.info("the static block was not read beforehand: %s", error)
        return self._client


def _http() -> type[LLMClient]:
    """The client, whose aiohttp takes a fifth of a second to import: the edge decides before that."""
    from service.llm.client import LLMClient

    return LLMClient
