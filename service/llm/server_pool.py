"""Several LLM servers in order of preference: the first that is well is asked, and the next one where that fails.

Each has its own health and circuit breaker. Optionally a second one is asked beside the first that keeps a UAV waiting
(a hedged request: Dean and Barroso 2013, "The Tail at Scale"); whoever answers first counts, and the other is hung up.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from typing import Any, Literal

from service.config.settings import Settings
from service.llm.answer_format import NoDecision
from service.llm.completion import Completion
from service.llm.request_bodies import Rewriting, WarmUp
from service.llm.server import LOST, LlmServer
from shared.wire import Readiness

Ask = Callable[[LlmServer], Coroutine[Any, Any, Completion]]


class ServerPool:
    """The LLM servers of one edge, as one; ``on_open`` hears when one's circuit breaker opens."""

    def __init__(self, settings: Settings, warm_up: WarmUp, on_open: Callable[[], None] = lambda: None) -> None:
        self._each = [LlmServer(one, warm_up, on_open) for one in settings.each_server()]
        self._hedge_s = settings.hedge_ms / 1e3 if settings.hedge_ms else None

    @property
    def active(self) -> LlmServer:
        """The one that is asked now: the first that is ready, or the first of all."""
        return next((server for server in self._each if server.status == "ready"), self._each[0])

    @property
    def status(self) -> Literal["loading", "ready", "unavailable", "off"]:
        """Where the active one stands."""
        return self.active.status

    @property
    def model(self) -> str | None:
        """The active one's."""
        return self.active.model

    @property
    def logprobs(self) -> bool:
        """Whether the active one tells the probabilities of tokens."""
        return self.active.logprobs

    @property
    def most_together(self) -> int:
        """UAVs that the active one may be asked about at once."""
        return self.active.most_together

    @most_together.setter
    def most_together(self, most: int) -> None:
        self.active.most_together = most

    @property
    def recovering(self) -> bool:
        """Whether one that is not ready may yet be, without anybody's doing."""
        return any(server.recovering for server in self._each)

    @property
    def statuses(self) -> Counter[str]:
        """How many servers stand where."""
        return Counter(server.status for server in self._each)

    @property
    def breakers_open(self) -> int:
        """How many servers' circuit breakers are open."""
        return sum(server.breaker_open for server in self._each)

    def readiness(self) -> Readiness:
        """What ``/readyz`` says: of the active one, and how many more are well."""
        active = self.active
        well = sum(server.status == "ready" for server in self._each if server is not active)
        return active.readiness().model_copy(update={"standing_by": well})

    def start(self) -> None:
        """Begin loading or probing all of them, unless the LLM is off."""
        for server in self._each:
            server.start()

    async def close(self) -> None:
        """Stop trying, close connections, free the embedded model."""
        await asyncio.gather(*(server.close() for server in self._each))

    async def ask(self, system: str, user: str, sensor_ids: list[int], velocities: int) -> Completion:
        """As :meth:`LlmServer.ask`."""
        return await self._first(lambda server: server.ask(system, user, sensor_ids, velocities))

    async def ask_labels(self, system: str, user: str, lists: Sequence[Sequence[str]]) -> Completion:
        """As :meth:`LlmServer.ask_labels`."""
        return await self._first(lambda server: server.ask_labels(system, user, lists), len(lists))

    async def rewrite(self, wanted: Rewriting, *, temperature: float, seed: int) -> str:
        """As :meth:`LlmServer.rewrite`, of the active one."""
        return await self.active.rewrite(wanted, temperature=temperature, seed=seed)

    async def _first(self, ask: Ask, uavs: int = 1) -> Completion:
        """The first answer of those that are well, asked one after another; the first failure where there is none."""
        well = [server for server in self._each if server.status == "ready" and server.most_together >= uavs]
        waiting = deque(well or self._each[:1])
        if self._hedge_s is not None and len(waiting) == 1:
            # Behind one address there may be several machines.
            waiting.append(waiting[0])
        if len(waiting) == 1:
            return replace(await ask(waiting[0]), model=waiting[0].model)
        running: dict[asyncio.Task[Completion], LlmServer] = {}
        failure: NoDecision | None = None
        later: list[asyncio.Task[Completion]] = []
        try:
            while waiting or running:
                if not running:
                    self._begin(ask, waiting, running)
                hedge = self._hedge_s if waiting and len(running) == 1 else None
                done, _ = await asyncio.wait(running, timeout=hedge, return_when=asyncio.FIRST_COMPLETED)
                if not done:
                    self._begin(ask, waiting, running)
                for task in done:
                    later = list(running)[list(running).index(task) + 1 :]
                    server = running.pop(task)
                    try:
                        return replace(task.result(), model=server.model)
                    except NoDecision as error:
                        failure = failure or error
                        waiting = deque(other for other in waiting if other is not server)
        finally:
            for task in running:
                task.cancel(LOST if task in later else None)
            await asyncio.gather(*running, return_exceptions=True)
        raise failure or NoDecision("llm_unavailable", "there is no server")

    @staticmethod
    def _begin(ask: Ask, waiting: deque[LlmServer], running: dict[asyncio.Task[Completion], LlmServer]) -> None:
        server = waiting.popleft()
        running[asyncio.create_task(ask(server), name="ask-llm")] = server
