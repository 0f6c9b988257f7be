"""The edge of a flight: its clients, the wait for it, and the mission made there."""

import os
import random
import time
from collections.abc import Callable

import httpx
from rich.console import Console
from rich.markup import escape

from shared.client.edge_client import API_KEY, EdgeClient
from shared.client.errors import EdgeRefused
from shared.planning.guidance_messages import GuidanceAnswer
from shared.wire.missions import MissionStatus
from shared.wire.schemas import MissionSpec
from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.flying.job import Job

# Without a requested deadline the edge's own applies, up to a minute; three attempts wait for one answer.
DEFAULT_TIMEOUT_S = 21.0
NETWORK_SLACK_S = 1.0
# The timeout of a readiness probe during an outage, short compared with the wait for the edge.
PROBE_TIMEOUT_S = 2.0


class LossyTransport(httpx.BaseTransport):
    """Delays every request by up to ``jitter_ms`` and loses a share ``drop`` of the requests.

    A lost request never reaches the edge: after its delay it raises ``httpx.ConnectTimeout``, which the client retries
    like a real loss. The draws depend only on ``seed``, two a request, so a repeated mission has the same losses.
    """

    def __init__(self, inner: httpx.BaseTransport, *, drop: float, jitter_ms: float, seed: int) -> None:
        self._inner = inner
        self._drop = drop
        self._jitter_s = jitter_ms / 1000
        self._random = random.Random(f"uplink-{seed}")

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Forward the request after a delay, or lose it: ``httpx.ConnectTimeout``."""
        delay, luck = self._random.random() * self._jitter_s, self._random.random()
        time.sleep(delay)
        if luck < self._drop:
            raise httpx.ConnectTimeout("the uplink lost the request", request=request)
        return self._inner.handle_request(request)

    def close(self) -> None:
        """Close the wrapped transport."""
        self._inner.close()


def create_or_check_mission(ground: EdgeClient, job: Job, spec: MissionSpec) -> MissionStatus:
    """The mission at the edge: made now, or, where the job names one that is there, that one.

    Raises:
        UsageError: the mission that is there has another world or mode, or has flown already.
        EdgeError: the edge refuses.
    """
    there = _existing(ground, job.mission_id) if job.named else None
    if there is None:
        return ground.put_mission(job.mission_id, spec)
    name = f"--mission {job.mission_id}: the edge has this mission"
    if there.decisions:
        raise UsageError(f"{name}, with {there.decisions} decisions already; choose another ID, or DELETE it there")
    if there.scenario.model_copy(update={"steps": job.site.scenario.steps}) != job.site.scenario:
        raise UsageError(f"{name}, for another world ({there.scenario.name}); give that --scenario or --world")
    # A flight may end earlier.
    if there.scenario.steps < job.site.scenario.steps:
        raise UsageError(f"{name}, of {there.scenario.steps} steps; give at most --steps {there.scenario.steps}")
    if job.mode is not None and there.mode != job.mode:
        raise UsageError(f"{name}, in mode {there.mode}; leave out --mode {job.mode}, or choose another ID")
    if job.note is not None and there.note != job.note:
        ground.answer_guidance(job.mission_id, GuidanceAnswer(note=job.note))
    return there


def _existing(ground: EdgeClient, mission_id: str) -> MissionStatus | None:
    try:
        return ground.mission(mission_id)
    except EdgeRefused as refused:
        if refused.status == 404:
            return None
        raise


def radio_link(scenario: Scenario, seed: int) -> LossyTransport | None:
    """The transport of the scenario's radio link; ``None`` for a lossless one."""
    if not scenario.uplink_drop and not scenario.uplink_jitter_ms:
        return None
    inner = httpx.HTTPTransport()
    return LossyTransport(inner, drop=scenario.uplink_drop, jitter_ms=scenario.uplink_jitter_ms, seed=seed)


def job_client(job: Job, edge: str, transport: httpx.BaseTransport | None = None) -> EdgeClient:
    """A client of the edge with the job's deadline and uplink; without ``transport`` its link is lossless."""
    timeout_s = DEFAULT_TIMEOUT_S if job.deadline_ms is None else job.deadline_ms / 1000 + NETWORK_SLACK_S
    key = os.environ.get(API_KEY) or None
    return EdgeClient(edge, timeout_s=timeout_s, api_key=key, seed=job.seed, transport=transport, uplink=job.uplink)


def probe_client(edge: str) -> EdgeClient:
    """A client that asks once and waits briefly, for the edge's state during an outage."""
    return EdgeClient(edge, timeout_s=PROBE_TIMEOUT_S, attempts=1, api_key=os.environ.get(API_KEY) or None)


def await_edge(
    ground: EdgeClient,
    wait_s: float,
    console: Console,
    alive: Callable[[], None] = lambda: None,
    wait_out: tuple[str, ...] = ("loading",),
) -> str | None:
    """Wait until the edge can decide and its LLM's state is none of ``wait_out``; returns the LLM's name, if any.

    Raises:
        EdgeError: no edge is ready within ``wait_s`` seconds.
    """
    with console.status(f"Waiting for the edge at {ground.base_url}") as status:

        def waiting(cause: str) -> None:
            alive()
            status.update(f"Waiting for the edge at {ground.base_url} (`aicvds serve` starts one): {escape(cause)}")

        readiness = ground.wait_ready(wait_s, wait_out, on_wait=waiting)
        alive()
    if readiness.llm == "ready":
        console.print(f"The edge is ready; its LLM is {escape(readiness.model or 'unnamed')}.")
    elif readiness.llm == "off":
        console.print("The edge is ready, without an LLM.")
    else:
        detail = f" ({readiness.detail})" if readiness.detail else ""
        console.print(f"The edge is ready; its LLM is {readiness.llm}{escape(detail)}, so its policy decides.")
    return readiness.model
