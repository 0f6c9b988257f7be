"""Several LLM servers in order: the first that is ready is called, and the next one where that fails.

The order is that of the settings, or each mission's own, so that missions are distributed evenly, and a mission's calls
go to the server whose prefix cache has its prompts. A server with the most calls allowed comes after the others. Each
server has its own health and circuit breaker. Optionally a second server is called if the first is slow (a hedged
request: Dean and Barroso 2013, "The Tail at Scale"). The first answer counts, and the other call is cancelled.
"""

import asyncio
import math
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Sequence
from hashlib import blake2b
from typing import Any, Literal

from service.config.settings import Settings
from service.llm.answers import Completion, NoDecision
from service.llm.embedded import Embed, embedded
from service.llm.request_bodies import Rewriting, WarmUp
from service.llm.server import EARLIER_CALL_ANSWERED, LlmServer
from shared.wire.reasons import LLM_FAILURES
from shared.wire.schemas import Readiness

Answer = Coroutine[Any, Any, Completion]
Call = Callable[[LlmServer], Answer]


def weight(key: str, name: str) -> int:
    """The weight of a name for a key, 0 to 2^64 - 1; the name of the highest weight is the key's.

    Rendezvous hashing (Thaler and Ravishankar 1998): processes that know the same names rank them alike for a key. If a
    name is removed, only its own keys move, evenly to the others; if it is added again, they return.
    """
    # The length keeps ("a", "bc") and ("ab", "c") apart.
    return int.from_bytes(blake2b(f"{len(key)}:{key}{name}".encode(), digest_size=8).digest())


class ServerPool:
    """The LLM servers of one edge, used as one server.

    Args:
        warm_up: the first request to each server.
        on_open: called when a server's circuit breaker opens.
        embed: as of :class:`LlmServer`.
    """

    def __init__(
        self, settings: Settings, warm_up: WarmUp, on_open: Callable[[], None] = lambda: None, embed: Embed = embedded
    ) -> None:
        self._each = [LlmServer(one, warm_up, on_open, embed) for one in settings.each_server()]
        self._hedge_s = settings.hedge_ms / 1e3 if settings.hedge_ms else None
        self._by_mission = settings.llm_order == "mission"
        self._slots = settings.llm_slots or math.inf
        # Calls under way by server; counted where there are several.
        self._calls = Counter[LlmServer]()

    @property
    def active(self) -> LlmServer:
        """The first server of the settings that is ready, or the first of all."""
        return _first_usable(self._each)

    def serving(self, mission_id: str) -> LlmServer:
        """The first server of a mission that is ready, or its first of all."""
        return _first_usable(self._each if len(self._each) == 1 else self._ordered(mission_id, self._each))

    @property
    def status(self) -> Literal["loading", "ready", "unavailable", "off"]:
        """The state of the active server."""
        return self.active.status.llm

    @property
    def notes_model(self) -> str | None:
        """The model with which the active server reads notes."""
        return self.active.connection.notes_model

    @property
    def reads_letters(self) -> bool:
        """As of the active :class:`LlmServer`."""
        return self.active.connection.reads_letters

    @property
    def recovering(self) -> bool:
        """Whether a server that is not ready may become ready without a restart."""
        return any(server.recovering for server in self._each)

    @property
    def statuses(self) -> Counter[str]:
        """Number of servers by state; a ready one whose answers cannot be used is degraded."""
        return Counter(server.readiness().llm for server in self._each)

    @property
    def breakers_open(self) -> int:
        """Number of open circuit breakers."""
        return sum(server.status.breaker_open for server in self._each)

    def readiness(self) -> Readiness:
        """The answer of ``/readyz``: the active server's, and the number of other ready servers."""
        active = self.active
        others = sum(server.status.llm == "ready" for server in self._each if server is not active)
        return active.readiness().model_copy(update={"standing_by": others})

    def record_usability(self, mission_id: str, fault: NoDecision | None, url: str | None = None) -> None:
        """Record whether the answer of the server ``url`` could be used; ``fault`` is the reason why not."""
        url = url or (fault.url if fault else None)
        server = next((one for one in self._each if url and one.url == url), self.serving(mission_id))
        if fault is None:
            server.usability.usable()
        elif fault.reason in LLM_FAILURES and fault.reason != "llm_timeout":
            server.usability.unusable(fault)

    def start(self) -> None:
        """Begin to load or reach all servers, unless the LLM is off."""
        for server in self._each:
            server.start()

    async def close(self) -> None:
        """Stop trying, close the connections, and free the embedded model."""
        await asyncio.gather(*(server.close() for server in self._each))

    # Plain functions that return a coroutine: a call resumes no coroutine that only passes its result on.

    def ask(self, mission_id: str, system: str, user: str, sensor_ids: list[int], velocities: int) -> Answer:
        """As :meth:`LlmServer.ask`."""
        return self._first(mission_id, lambda server: server.ask(mission_id, system, user, sensor_ids, velocities))

    def ask_labels(self, mission_id: str, system: str, user: str, lists: Sequence[Sequence[str]]) -> Answer:
        """As :meth:`LlmServer.ask_labels`."""
        return self._first(mission_id, lambda server: server.ask_labels(mission_id, system, user, lists), len(lists))

    async def rewrite(self, wanted: Rewriting, *, temperature: float, seed: int) -> Completion:
        """As :meth:`LlmServer.rewrite`, by the active server."""
        return await self.active.rewrite(wanted, temperature=temperature, seed=seed)

    def _first(self, mission_id: str, call: Call, uavs: int = 1) -> Answer:
        """The first answer of the ready servers."""
        ready = [s for s in self._each if s.status.llm == "ready" and s.connection.abilities.max_uavs_per_call >= uavs]
        if len(ready) > 1:
            # A stable sort: where every server is full, the order is as without a limit.
            ready = sorted(self._ordered(mission_id, ready), key=lambda each: self._calls[each] >= self._slots)
            ready.sort(key=lambda each: each.paused or each.usability.degraded is not None)
        waiting = deque(ready or self._each[:1])
        if self._hedge_s is not None and len(waiting) == 1:
            # A hedge to the same address: there may be several machines behind it.
            waiting.append(waiting[0])
        return call(waiting[0]) if len(waiting) == 1 else self._of_several(call, waiting)

    async def _of_several(self, call: Call, waiting: deque[LlmServer]) -> Completion:
        """The first answer of servers called one after another; raises the first failure if there is none."""
        running: dict[asyncio.Task[Completion], LlmServer] = {}
        failure: NoDecision | None = None
        # The calls that began after the answered one: their silence is no failure of their servers.
        later: list[asyncio.Task[Completion]] = []
        try:
            while waiting or running:
                if not running:
                    self._begin(call, waiting, running)
                hedge = self._hedge_s if waiting and len(running) == 1 else None
                done, _ = await asyncio.wait(running, timeout=hedge, return_when=asyncio.FIRST_COMPLETED)
                if not done:
                    self._begin(call, waiting, running)
                for task in done:
                    later = list(running)[list(running).index(task) + 1 :]
                    server = running.pop(task)
                    try:
                        return task.result()
                    except NoDecision as error:
                        failure = failure or error
                        waiting = deque(other for other in waiting if other is not server)
        finally:
            for task in running:
                task.cancel(EARLIER_CALL_ANSWERED if task in later else None)
            await asyncio.gather(*running, return_exceptions=True)
        raise failure or NoDecision("llm_unavailable", "there is no server")

    def _ordered(self, mission_id: str, servers: list[LlmServer]) -> list[LlmServer]:
        """Servers in a mission's order: the one of the settings, or by rendezvous hashing."""
        if not self._by_mission:
            return servers
        return sorted(servers, key=lambda server: weight(mission_id, server.url), reverse=True)

    def _begin(self, call: Call, waiting: deque[LlmServer], running: dict[asyncio.Task[Completion], LlmServer]) -> None:
        server = waiting.popleft()
        self._calls[server] += 1
        task = asyncio.create_task(call(server), name="ask-llm")
        task.add_done_callback(lambda _: self._calls.subtract([server]))
        running[task] = server


def _first_usable(servers: Sequence[LlmServer]) -> LlmServer:
    """The first ready server whose answers can be used, else the first ready one, else the first."""
    ready = [server for server in servers if server.status.llm == "ready"]
    return next((server for server in ready if server.usability.degraded is None), (ready or servers)[0])
