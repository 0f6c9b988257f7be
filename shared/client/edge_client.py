"""Clients of one edge over HTTP, with bounded retries and timed decisions: a blocking one and one for asyncio."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection
from typing import Self

import httpx

from shared.client.retries_and_redirects import Call, Calls, Exchange, Pause, Result
from shared.planning.orders import GuidanceAnswer, GuidanceStatus
from shared.wire.missions import MissionStatus
from shared.wire.readings import ReadingsRequest, ReadingsResponse
from shared.wire.schemas import (
    BatchRequest,
    BatchResponse,
    DecideRequest,
    FeedbackRequest,
    FeedbackResponse,
    MissionSpec,
    Readiness,
    Uplink,
)

# The environment variable with the key for the edge.
API_KEY = "AICVDS_API_KEY"


class EdgeClient:
    """A synchronous client of one edge; use it as a context manager.

    Connection errors, timeouts and 429/502/503/504 are retried, ``attempts`` attempts in all. The pause before a retry
    is random, at most 0.1 s, and this limit doubles each time up to 2 s; a ``Retry-After`` is honoured up to 5 s. Where
    several edges share their missions, a 421 names the edge that has the mission, and the request goes there at once.
    ``timeout_s`` bounds each wait for the network within one attempt. ``transport`` replaces the network (see
    :mod:`simulator.flying.lossy_transport`); ``seed`` fixes the draws of the pauses. ``uplink`` selects the part of a
    report that is sent: all of it (``full``), the changes (``delta``), or the sensors that the mission's attention,
    computed here, keeps (``pruned``). Every call takes the full report, and the full report is sent where the edge
    needs it.

    Raises (every method):
        EdgeUnreachable: no attempt succeeded.
        EdgeRefused: the edge answered with an error that a retry cannot cure.
        EdgeProtocolError: the server is no AIC-VDS edge.
    """

    def __init__(
        self,
        base_url: str,
        *,
        timeout_s: float = 5.0,
        attempts: int = 3,
        api_key: str | None = None,
        seed: int = 0,
        transport: httpx.BaseTransport | None = None,
        uplink: Uplink = "full",
    ) -> None:
        self._calls = Calls(base_url, attempts, seed, uplink)
        self.base_url = self._calls.base_url
        self._http = httpx.Client(
            headers=_headers(api_key),
            timeout=_checked(timeout_s),
            transport=transport,
            trust_env=_beyond_this_machine(self.base_url),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def _run(self, call: Call[Result]) -> Result:
        try:
            todo = next(call)
            while True:
                if isinstance(todo, Pause):
                    time.sleep(todo.seconds)
                    todo = call.send(None)
                    continue
                try:
                    answer = self._http.request(
                        todo.method,
                        (todo.base_url or self.base_url) + todo.path,
                        content=todo.content,
                        headers=todo.headers,
                    )
                except httpx.RequestError as error:
                    todo = call.throw(error)
                else:
                    todo = call.send(answer)
        except StopIteration as done:
            result: Result = done.value
            return result

    def wait_ready(
        self,
        timeout_s: float,
        wait_out: Collection[str] = ("loading",),
        on_wait: Callable[[str], None] | None = None,
    ) -> Readiness:
        """Poll ``/readyz`` until the edge can decide and its LLM's state is none of ``wait_out``.

        After ``timeout_s`` seconds the readiness of an edge that can decide is returned whatever its LLM's state.
        ``on_wait`` is called with the cause of the wait before each pause.
        """
        return self._run(self._calls.wait_ready(timeout_s, wait_out, on_wait))

    def put_mission(self, mission_id: str, spec: MissionSpec) -> MissionStatus:
        """Create the mission at the edge."""
        return self._run(self._calls.put_mission(mission_id, spec))

    def mission(self, mission_id: str) -> MissionStatus:
        """The mission's status."""
        return self._run(self._calls.mission(mission_id))

    def delete_mission(self, mission_id: str) -> None:
        """Delete the mission and its learned state at the edge."""
        self._run(self._calls.delete_mission(mission_id))

    def guidance(self, mission_id: str) -> GuidanceStatus:
        """The edge's compilation of the operator's note, and its state."""
        return self._run(self._calls.guidance(mission_id))

    def answer_guidance(self, mission_id: str, given: GuidanceAnswer) -> GuidanceStatus:
        """Confirm or reject the compiled guidance, or replace it by a structure."""
        return self._run(self._calls.answer_guidance(mission_id, given))

    def decide(self, request: DecideRequest, attempts: int | None = None) -> Exchange:
        """Request one decision, and time it; ``attempts`` overrides the client's."""
        return self._run(self._calls.decide(request, attempts))

    def decide_batch(self, request: BatchRequest) -> BatchResponse:
        """Request the decisions for all UAVs of a step."""
        return self._run(self._calls.decide_batch(request))

    def read(self, mission_id: str, readings: ReadingsRequest) -> ReadingsResponse:
        """Report what sensors said of themselves over another network than the UAVs' radios."""
        return self._run(self._calls.read(mission_id, readings))

    def feedback(self, outcome: FeedbackRequest) -> FeedbackResponse:
        """Send an outcome without a request for a decision."""
        return self._run(self._calls.feedback(outcome))


class AsyncEdgeClient:
    """:class:`EdgeClient` for asyncio: the same calls, retries and errors; use it as an asynchronous context manager.

    A cancelled call is not retried. ``transport`` replaces the network.
    """

    def __init__(
        self,
        base_url: str,
        *,
        timeout_s: float = 5.0,
        attempts: int = 3,
        api_key: str | None = None,
        seed: int = 0,
        transport: httpx.AsyncBaseTransport | None = None,
        uplink: Uplink = "full",
    ) -> None:
        self._calls = Calls(base_url, attempts, seed, uplink)
        self.base_url = self._calls.base_url
        self._http = httpx.AsyncClient(
            headers=_headers(api_key),
            timeout=_checked(timeout_s),
            transport=transport,
            trust_env=_beyond_this_machine(self.base_url),
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def _run(self, call: Call[Result]) -> Result:
        try:
            todo = next(call)
            while True:
                if isinstance(todo, Pause):
                    await asyncio.sleep(todo.seconds)
                    todo = call.send(None)
                    continue
                try:
                    answer = await self._http.request(
                        todo.method,
                        (todo.base_url or self.base_url) + todo.path,
                        content=todo.content,
                        headers=todo.headers,
                    )
                except httpx.RequestError as error:
                    todo = call.throw(error)
                else:
                    todo = call.send(answer)
        except StopIteration as done:
            result: Result = done.value
            return result

    async def wait_ready(
        self,
        timeout_s: float,
        wait_out: Collection[str] = ("loading",),
        on_wait: Callable[[str], None] | None = None,
    ) -> Readiness:
        """Poll ``/readyz`` until the edge can decide and its LLM's state is none of ``wait_out``.

        After ``timeout_s`` seconds the readiness of an edge that can decide is returned whatever its LLM's state.
        ``on_wait`` is called with the cause of the wait before each pause.
        """
        return await self._run(self._calls.wait_ready(timeout_s, wait_out, on_wait))

    async def put_mission(self, mission_id: str, spec: MissionSpec) -> MissionStatus:
        """Create the mission at the edge."""
        return await self._run(self._calls.put_mission(mission_id, spec))

    async def mission(self, mission_id: str) -> MissionStatus:
        """The mission's status."""
        return await self._run(self._calls.mission(mission_id))

    async def delete_mission(self, mission_id: str) -> None:
        """Delete the mission and its learned state at the edge."""
        await self._run(self._calls.delete_mission(mission_id))

    async def guidance(self, mission_id: str) -> GuidanceStatus:
        """The edge's compilation of the operator's note, and its state."""
        return await self._run(self._calls.guidance(mission_id))

    async def answer_guidance(self, mission_id: str, given: GuidanceAnswer) -> GuidanceStatus:
        """Confirm or reject the compiled guidance, or replace it by a structure."""
        return await self._run(self._calls.answer_guidance(mission_id, given))

    async def decide(self, request: DecideRequest, attempts: int | None = None) -> Exchange:
        """Request one decision, and time it; ``attempts`` overrides the client's."""
        return await self._run(self._calls.decide(request, attempts))

    async def decide_batch(self, request: BatchRequest) -> BatchResponse:
        """Request the decisions for all UAVs of a step."""
        return await self._run(self._calls.decide_batch(request))

    async def read(self, mission_id: str, readings: ReadingsRequest) -> ReadingsResponse:
        """Report what sensors said of themselves over another network than the UAVs' radios."""
        return await self._run(self._calls.read(mission_id, readings))

    async def feedback(self, outcome: FeedbackRequest) -> FeedbackResponse:
        """Send an outcome without a request for a decision."""
        return await self._run(self._calls.feedback(outcome))


def _headers(api_key: str | None) -> dict[str, str]:
    headers = {"Content-Type": "application/json", "Accept": "application/json"}
    return headers if api_key is None else {**headers, "Authorization": f"Bearer {api_key}"}


def _checked(timeout_s: float) -> float:
    if not timeout_s > 0:
        raise ValueError(f"timeout_s must be positive, not {timeout_s}")
    return timeout_s


def _beyond_this_machine(base_url: str) -> bool:
    # A proxy named in the environment cannot reach an edge on this machine's loopback.
    return httpx.URL(base_url).host not in ("localhost", "127.0.0.1", "::1")
