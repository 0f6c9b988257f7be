"""One LLM server: its life cycle, its health, and the calls that the edge makes to it."""

from __future__ import annotations

import asyncio
import importlib
import logging
import time
from collections.abc import Callable, Sequence
from contextvars import Context
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from service.config.settings import Settings
from service.llm.adapter_version import AdapterUnusable
from service.llm.answers import Busy, Completion, NoDecision, NotUnderstood, Unreachable
from service.llm.circuit_breaker import CircuitBreaker, SilenceCounter
from service.llm.decision_priority import DecisionPriority
from service.llm.embedded import Embed, EmbeddedServer, LoadFailed, embedded
from service.llm.model_file import ModelMissing
from service.llm.probing import Abilities, first_decision, listed_model, probe, probe_body
from service.llm.request_bodies import (
    SEVERAL_LABELS_TEMPERATURE,
    Rewriting,
    WarmUp,
    chat_body,
    label_body,
    rewriting_body,
)
from service.llm.usability import Usability
from shared.wire.reasons import Reason
from shared.wire.schemas import Readiness

if TYPE_CHECKING:
    from service.llm.client import LLMClient

log = logging.getLogger(__name__)

_RETRY_S = 5.0
# Message to a call that is cancelled because an earlier call was answered, which is no failure of this server.
EARLIER_CALL_ANSWERED = "another answered"
_PROBE_TIMEOUT_S = 60.0


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
    ``unavailable`` too, until a probe is answered: see :mod:`service.llm.circuit_breaker`.

    Args:
        warm_up: the first request to a server.
        on_open: called when the circuit breaker opens.
        embed: returns the embedded LLM; by default it loads one.

    Attributes:
        status: replaced as a whole when the state changes.
        usability: whether its answers can be used.
        url: the server's address; empty for the embedded LLM.
        model, bare_model: name of the model, once it is known, with its adapter and without.
        notes_model: name of the model that reads notes.
        reads_letters: whether that model has the orders' adapter, which reads notes whose numbers are letters.
        abilities: what its probes found.
        decision_s: duration of the last probe's decision; None before it.
    """

    def __init__(
        self, settings: Settings, warm_up: WarmUp, on_open: Callable[[], None] = lambda: None, embed: Embed = embedded
    ) -> None:
        self._settings = settings
        self._embed = embed
        self._warm_up = warm_up
        self._on_open = on_open
        self.status = ServerStatus("off" if settings.mode in ("value", "policy") else "loading")
        self.url = settings.llm_url or ""
        self._client: LLMClient | None = None
        self._embedded: EmbeddedServer | None = None
        # Brings the server up, or waits for its recovery.
        self._task: asyncio.Task[None] | None = None
        self.model = self.bare_model = self.notes_model = settings.llm_model
        self.reads_letters = False
        self.abilities = Abilities()
        self.decision_s: float | None = None
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
        ready = self.status.llm == "ready"
        return Readiness(
            ready=True,
            decides=self._settings.mode if ready else "policy",
            llm="degraded" if ready and self.usability.degraded else self.status.llm,
            model=self.model,
            constraint=self.abilities.constraint if ready else None,
            abilities=self._in_words() if ready else None,
            decision_ms=self.decision_s and round(self.decision_s * 1e3, 1),
            detail=self.usability.degraded if ready else self.status.detail,
        )

    def _in_words(self) -> str:
        terms = "" if self._client is None else str(self._client.terms)
        return f"{self.abilities}; with {terms}" if terms else str(self.abilities)

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
        if self._client is not None:
            await self._client.close()
        if self._embedded is not None:
            await asyncio.to_thread(self._embedded.close)

    async def ask(self, mission_id: str, system: str, user: str, sensor_ids: list[int], velocities: int) -> Completion:
        """Call for one decision's sensor and velocity; the caller sets the time limit.

        Raises:
            NoDecision: no answer, with the reason.
        """
        body = chat_body(self.model, system, user, self.abilities.constraint, sensor_ids, velocities)
        return await self._decide(mission_id, body, self._silence)

    async def ask_labels(self, mission_id: str, system: str, user: str, lists: Sequence[Sequence[str]]) -> Completion:
        """Call for one label of each list, with the likeliest tokens' probabilities where the server gives them.

        Raises:
            NoDecision: no answer, with the reason.
        """
        body = label_body(self.model, system, user, self.abilities.constraint, lists, self.abilities.logprobs)
        # The silence of a call for several UAVs says nothing about calls for one.
        answer = await self._decide(mission_id, body, self._silence if len(lists) == 1 else None)
        if self.abilities.logprobs != "sampled" or len(lists) == 1:
            return answer
        positions = tuple(position.untempered(SEVERAL_LABELS_TEMPERATURE) for position in answer.positions)
        return replace(answer, positions=positions)

    async def rewrite(self, wanted: Rewriting, *, temperature: float, seed: int) -> Completion:
        """Call for a rewritten text.

        The embedded model has one slot: decisions cancel the call up to three times, and it starts again.

        Raises:
            ValueError: ``wanted.constrain`` finds nothing to rewrite.
            NoDecision: no answer, with the reason.
        """
        body = rewriting_body(self.model, wanted, wanted.constrain(self.abilities.constraint), temperature, seed)
        ask = partial(self._ask_about_note, body)
        return await ask() if self._embedded is None else await self._priority.answer(ask)

    async def _decide(self, mission_id: str, body: dict[str, Any], silence: SilenceCounter | None) -> Completion:
        """Call for a decision, and count its result; ``silence`` counts the wait of a cancelled call."""
        started = time.monotonic()
        try:
            with self._priority.decision():
                answer = await self._ask(body, mission_id)
        except (NotUnderstood, Busy):
            # The fault is the request's, or will be over by itself.
            raise
        except NoDecision as error:
            self._failed(error.reason)
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

    async def _ask(self, body: dict[str, Any], mission_id: str | None = None) -> Completion:
        embedded, system = self._embedded, body["messages"][0]["content"]
        if embedded is None:
            return replace(await self._complete(body, mission_id), model=self.model)
        with embedded.request(system, self._warm_up.static) as fields:
            answer = await self._complete(body | fields)
        return replace(answer, model=self.bare_model if "lora" in fields else self.model)

    async def _ask_about_note(self, body: dict[str, Any]) -> Completion:
        if self._embedded is None:
            return replace(await self._complete(body), model=self.model)
        with self._embedded.note_request() as fields:
            return replace(await self._complete(body | fields), model=self.notes_model)

    async def _complete(self, body: dict[str, Any], mission_id: str | None = None) -> Completion:
        if self._client is None or self.status.llm != "ready":
            raise NoDecision("llm_loading" if self.status.llm == "loading" else "llm_unavailable", self.status.llm)
        if self._busy is not None and self.paused:
            raise Busy(str(self._busy), self._busy.until)
        try:
            return await self._client.complete(body, mission_id)
        except Busy as busy:
            self._busy = busy
            raise
        except Unreachable as gone:
            if self.status.llm == "ready":
                self.status = ServerStatus("unavailable", str(gone))
                self.start()
            raise

    def _failed(self, reason: Reason) -> None:
        if self.status.llm != "ready" or not self._breaker.failed():
            return
        pause_s = self._breaker.pause_s
        detail = f"failed too often, the last time by {reason}: no calls for {pause_s:g} s"
        self.status = ServerStatus("unavailable", detail, breaker_open=True)
        log.warning("LLM %s", self.status.detail)
        self._on_open()
        self._task = asyncio.create_task(self._recover(), name="llm-recovery", context=Context())

    async def _recover(self) -> None:
        """After the breaker has opened: pause and probe, until a probe is answered."""
        while self._client is not None:
            await asyncio.sleep(self._breaker.pause_s)
            try:
                async with asyncio.timeout(_PROBE_TIMEOUT_S):
                    await self._client.complete(probe_body(self.model, self.abilities.constraint))
            except (NoDecision, TimeoutError) as error:
                self._breaker.failed()
                log.warning("LLM still fails, next try in %g s: %s", self._breaker.pause_s, error)
            else:
                self.status = ServerStatus("ready")
                log.info("LLM answers again: %s", self.model)
                return

    async def _bring_up(self) -> None:
        while True:
            try:
                client = await self._connect()
                self.status = ServerStatus("ready")
                log.info("LLM ready: %s at %s, %s", self.model, client.base_url, self._in_words())
                if self.decision_s is not None and self.decision_s * 1e3 > self._settings.deadline_ms:
                    text = "LLM too slow: a decision took %.2f s, the deadline is %d ms"
                    log.warning(text, self.decision_s, self._settings.deadline_ms)
                return
            except (ModelMissing, AdapterUnusable, LoadFailed) as error:
                self.status = ServerStatus("unavailable", str(error))
                log.error("no embedded LLM: %s", error)
                return
            except (NoDecision, TimeoutError) as error:
                self.status = ServerStatus("unavailable", str(error) or f"no answer in {_PROBE_TIMEOUT_S:g} s")
                log.warning("LLM not ready, next try in %g s: %s", _RETRY_S, self.status.detail)
            except Exception as error:
                self.status = ServerStatus("unavailable", f"{type(error).__name__}: see the log")
                log.exception("LLM not ready, next try in %g s", _RETRY_S)
            await asyncio.sleep(_RETRY_S)

    async def _connect(self) -> LLMClient:
        """Reach or load the LLM, probe its abilities, and send the warm-up."""
        settings, client_module = self._settings, await asyncio.to_thread(_client_module)
        if self._client is None and settings.llm_url is not None:
            self._client = client_module.client_of(settings)
        elif self._client is None:
            self._embedded = await self._embed(settings)
            key = self._embedded.api_key
            self._client = client_module.LLMClient(self._embedded.base_url, api_key=key, trust_env=False)
            self.model = self.model or self._embedded.model
            self.bare_model = self.bare_model or self._embedded.bare_model
            self.notes_model = self.notes_model or self._embedded.notes_model
            self.reads_letters = bool(self._embedded.with_orders)
        async with asyncio.timeout(settings.llm_load_s):
            await self._find_abilities(self._client)
        try:
            await self._judge(self._client)
        except (NoDecision, TimeoutError) as error:
            log.warning("the LLM's answer to the first question cannot be used: %s", error or "none in time")
        return self._client

    async def _judge(self, client: LLMClient) -> None:
        """Send the warm-up, and check its answer as a decision's; raises :class:`NoDecision` or ``TimeoutError``."""
        async with asyncio.timeout(_PROBE_TIMEOUT_S):
            enough_s = self._settings.deadline_ms / 1e3
            _, self.decision_s = await first_decision(client, self.model, self._warm_up, self.abilities, enough_s)

    async def _find_abilities(self, client: LLMClient) -> None:
        """Ask the server for its model, unless the settings or the model file name one, and for its abilities."""
        named = self._embedded is not None or self._settings.llm_model is not None
        if not named:
            self.model = await listed_model(client)
        self.abilities = await probe(client, self.model)
        if not named:
            # A server that has loaded its model meanwhile lists it now.
            self.model = self.bare_model = self.notes_model = self.model or await listed_model(client)

    async def _probe_again(self) -> None:
        """Probe a ready server whose answers cannot be used: it may have another model now."""
        if self._client is None or self.status.llm != "ready":
            raise NoDecision("llm_unavailable", self.status.llm)
        async with asyncio.timeout(_PROBE_TIMEOUT_S):
            await self._find_abilities(self._client)
        await self._judge(self._client)


def _client_module() -> ModuleType:
    """The client's module, imported in a thread: importing aiohttp takes a fifth of a second."""
    return importlib.import_module("service.llm.client")
