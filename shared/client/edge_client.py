"""Clients of one edge over HTTP, with bounded retries and timed decisions: a blocking one and one for asyncio.

Both have the calls of :class:`shared.client.calls.Calls`, with the same arguments and results.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import httpx

from shared.client.calls import Calls
from shared.client.retries_and_redirects import Requests, Sleep, edge_url
from shared.wire.schemas import Uplink

# The environment variable with the key for the edge.
API_KEY = "AICVDS_API_KEY"

P = ParamSpec("P")
Result = TypeVar("Result")


class AsyncEdgeClient(Calls):
    """:class:`EdgeClient` for asyncio: the same calls, retries and errors; use it as an asynchronous context manager.

    A cancelled call is not retried.
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
        sleep: Sleep = asyncio.sleep,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._http = httpx.AsyncClient(transport=transport, **_http_options(base_url, timeout_s, api_key))
        super().__init__(Requests(base_url, self._http.request, sleep, attempts, seed), uplink, sleep, clock)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close the connections."""
        await self._http.aclose()


def _blocking(
    call: Callable[Concatenate[Calls, P], Coroutine[Any, Any, Result]],
) -> "Callable[Concatenate[EdgeClient, P], Result]":
    """The call as a method of the blocking client."""

    @wraps(call)
    def method(client: "EdgeClient", /, *args: P.args, **kwargs: P.kwargs) -> Result:
        # It never suspends, so that its first step is its last.
        try:
            call(client._calls, *args, **kwargs).send(None)
        except StopIteration as done:
            result: Result = done.value
            return result
        raise AssertionError("a blocking call waits in its own thread")

    return method


def _never_suspending(function: Callable[P, Result]) -> Callable[P, Coroutine[Any, Any, Result]]:
    async def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        return function(*args, **kwargs)

    return call


class EdgeClient:
    """A synchronous client of one edge; use it as a context manager.

    Connection errors, timeouts and 408/429/502/503/504 are retried, ``attempts`` attempts in all. The pause before a
    retry is random, at most 0.1 s, and this limit doubles each time up to 2 s; a ``Retry-After`` is honoured up to 5 s.
    Where several edges share their missions, a 421 names the edge that has the mission, and the request goes there at
    once. ``timeout_s`` bounds each wait for the network within one attempt. ``transport`` replaces the network (see
    :mod:`simulator.flying.edge_session`), ``sleep`` the pauses and ``clock`` the time; ``seed`` fixes the draws of
    the pauses. ``uplink`` selects the part of a report that is sent: all of it (``full``), the changes (``delta``), or
    the sensors that the mission's attention, computed here, keeps (``pruned``). Every call takes the full report, and
    the full report is sent where the edge needs it.

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
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._http = httpx.Client(transport=transport, **_http_options(base_url, timeout_s, api_key))
        request, pause = _never_suspending(self._http.request), _never_suspending(sleep)
        self._calls = Calls(Requests(base_url, request, pause, attempts, seed), uplink, pause, clock)
        self.base_url = self._calls.base_url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    wait_ready = _blocking(Calls.wait_ready)
    put_mission = _blocking(Calls.put_mission)
    mission = _blocking(Calls.mission)
    delete_mission = _blocking(Calls.delete_mission)
    guidance = _blocking(Calls.guidance)
    answer_guidance = _blocking(Calls.answer_guidance)
    decide = _blocking(Calls.decide)
    send_readings = _blocking(Calls.send_readings)
    feedback = _blocking(Calls.feedback)


def _http_options(base_url: str, timeout_s: float, api_key: str | None) -> dict[str, Any]:
    if not timeout_s > 0:
        raise ValueError(f"timeout_s must be positive, not {timeout_s}")
    headers: dict[str, str | bytes] = {"Content-Type": "application/json", "Accept": "application/json"}
    if api_key is not None:
        headers["Authorization"] = f"Bearer {api_key.strip()}".encode()
    # A proxy named in the environment cannot reach an edge on this machine's loopback.
    beyond = httpx.URL(edge_url(base_url)).host not in ("localhost", "127.0.0.1", "::1")
    return {"headers": headers, "timeout": timeout_s, "trust_env": beyond}
