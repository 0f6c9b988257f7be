"""The calls to an edge, each described once: its request, its answer, and what is checked of it."""

import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Self

import httpx
from pydantic import BaseModel

from shared.client.errors import EdgeError, EdgeProtocolError, EdgeRefused, EdgeUnreachable
from shared.client.report_encoders import DeltaReports, FullReports
from shared.client.retries_and_redirects import NOT_MODIFIED, Answer, Requests, Send, Sleep, TryAgain, parse
from shared.planning.guidance_messages import GuidanceAnswer, GuidanceStatus
from shared.wire.missions import MissionStatus
from shared.wire.problem import INCOMPLETE
from shared.wire.readings import ReadingsRequest, ReadingsResponse
from shared.wire.schemas import (
    MAX_COST,
    MAX_ROUND_TRIP_MS,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    MissionSpec,
    Outcome,
    Readiness,
    Uplink,
)
from shared.world.scenario import Scenario

POLL_S = 0.5


@dataclass(frozen=True)
class Exchange:
    """One decision and its transfer.

    ``rtt_ms`` is the time from the first attempt to the answer, retries included, in milliseconds. ``request_bytes``
    and ``response_bytes`` are the sizes of the bodies, the request's of one attempt. A report that the edge could not
    complete is sent again in full, and then ``request_bytes`` counts both bodies. ``attention_bytes`` is the size of
    the weights that a UAV with pruning on board fetched before the request, as transferred.
    """

    response: DecideResponse
    rtt_ms: float
    attempts: int
    request_bytes: int
    response_bytes: int
    attention_bytes: int = 0

    def outcome(self, cost: float, failed: bool) -> Outcome:
        """The outcome of the decision, for this UAV's next request."""
        round_trip_ms = min(round(self.rtt_ms, 3), MAX_ROUND_TRIP_MS)
        decision_id, cost = self.response.decision_id, min(cost, MAX_COST)
        return Outcome(decision_id=decision_id, cost=cost, failed=failed, round_trip_ms=round_trip_ms)

    def within(self, scenario: Scenario) -> Self:
        """This exchange; raises ``EdgeProtocolError`` for a sensor or a velocity that the scenario does not have."""
        sensor, velocity = self.response.sensor_id, self.response.velocity
        if sensor >= scenario.sensors or velocity > scenario.max_velocity:
            limits = f"there are {scenario.sensors} sensors and at most {scenario.max_velocity} m/s"
            raise EdgeProtocolError(f"the edge chose sensor {sensor} at {velocity} m/s, {limits}")
        return self


class Calls:
    """The calls to one edge.

    Args:
        requests: to that edge.
        uplink: selects the encoder of the reports.
        sleep: as ``asyncio.sleep``.
        clock: seconds since some instant.
    """

    def __init__(self, requests: Requests, uplink: Uplink, sleep: Sleep, clock: Callable[[], float]) -> None:
        self.base_url = requests.base_url
        self._requests, self._sleep, self._clock = requests, sleep, clock
        self._encoder = _encoder_of(uplink)
        # Reduced reports omit fields at their defaults too.
        self._terse = uplink != "full"

    async def wait_ready(
        self, timeout_s: float, wait_out: Collection[str] = ("loading",), on_wait: Callable[[str], None] | None = None
    ) -> Readiness:
        """Poll ``/readyz`` until the edge can decide and its LLM's state is none of ``wait_out``.

        After ``timeout_s`` seconds the readiness of an edge that can decide is returned whatever its LLM's state.
        ``on_wait`` is called with the cause of the wait before each pause.
        """
        deadline = self._clock() + timeout_s
        while True:
            readiness: Readiness | None = None
            try:
                readiness = parse(Readiness, await self._requests.attempt(Send("GET", "/readyz")))
                state = f"the LLM is {readiness.llm}" if readiness.ready else "not ready"
                cause = f"{state}: {readiness.detail}" if readiness.detail else state
            except TryAgain as again:
                cause = again.cause
            left_s = deadline - self._clock()
            if readiness is not None and readiness.ready and (readiness.llm not in wait_out or left_s <= 0):
                return readiness
            if left_s <= 0:
                raise EdgeUnreachable(f"no edge is ready at {self.base_url} after {timeout_s:g} s: {cause}")
            if on_wait is not None:
                on_wait(cause)
            await self._sleep(min(POLL_S, left_s))

    async def put_mission(self, mission_id: str, spec: MissionSpec) -> MissionStatus:
        """Create the mission at the edge."""
        return await self._call("PUT", f"/missions/{mission_id}", MissionStatus, spec)

    async def mission(self, mission_id: str) -> MissionStatus:
        """The mission's status."""
        return await self._call("GET", f"/missions/{mission_id}", MissionStatus)

    async def delete_mission(self, mission_id: str) -> None:
        """Delete the mission and its learned state at the edge."""
        await self._requests.exchange(Send("DELETE", f"/missions/{mission_id}"))

    async def guidance(self, mission_id: str) -> GuidanceStatus:
        """The edge's compilation of the operator's note, and its state."""
        return await self._call("GET", f"/missions/{mission_id}/guidance", GuidanceStatus)

    async def answer_guidance(self, mission_id: str, given: GuidanceAnswer) -> GuidanceStatus:
        """Confirm or reject the compiled guidance, or replace it by a structure."""
        return await self._call("POST", f"/missions/{mission_id}/guidance", GuidanceStatus, given)

    async def send_readings(self, mission_id: str, readings: ReadingsRequest) -> ReadingsResponse:
        """Send what sensors reported over another network than the UAVs' radios."""
        return await self._call("POST", f"/missions/{mission_id}/readings", ReadingsResponse, readings)

    async def feedback(self, outcome: FeedbackRequest) -> FeedbackResponse:
        """Send an outcome without a request for a decision."""
        return await self._call("POST", "/feedback", FeedbackResponse, outcome)

    async def decide(self, request: DecideRequest, attempts: int | None = None) -> Exchange:
        """Request one decision, and time it; ``attempts`` overrides the client's."""
        fetched = await self._refresh(request)
        began, body = self._clock(), self._body(request)
        sent = len(body)
        try:
            answer, tried = await self._decide(body, attempts)
        except EdgeRefused as refused:
            if refused.type != INCOMPLETE:
                raise
            self._encoder.forget(request.uav_id)
            body = self._body(request)
            answer, tried = await self._decide(body, attempts)
            sent, tried = sent + len(body), 1 + tried
        rtt_ms = (self._clock() - began) * 1000
        response = parse(DecideResponse, answer)
        if (response.uav_id, response.step) != (request.uav_id, request.step):
            raise EdgeProtocolError(f"{answer.url} answered for another UAV or step")
        self._encoder.record_answer(request, response)
        return Exchange(response, rtt_ms, tried, sent, len(answer.content), fetched)

    def _body(self, request: DecideRequest) -> bytes:
        report = self._encoder.encode(request.mission_id, request.step, request)
        return report.model_dump_json(exclude_defaults=self._terse).encode()

    async def _decide(self, body: bytes, attempts: int | None) -> tuple[httpx.Response, int]:
        # A retry with the same key after a lost response gets that response.
        headers = {"Idempotency-Key": uuid.uuid4().hex}
        return await self._requests.exchange(Send("POST", "/decide", body, headers), attempts)

    async def _refresh(self, request: DecideRequest) -> int:
        """Fetch the resources that the uplink's encoder needs; returns the bytes fetched.

        After a failed fetch, the encoder works with the resources that it has: the decision must not fail.
        """
        uav_id, step, fetched = request.uav_id, request.step, 0
        try:
            while (wanted := self._encoder.next_fetch(request.mission_id, step, uav_id)) is not None:
                headers = None if wanted.etag is None else {"If-None-Match": wanted.etag}
                answer, _ = await self._requests.exchange(Send("GET", wanted.path, headers=headers), attempts=1)
                fetched += answer.num_bytes_downloaded
                resource = None if answer.status_code == NOT_MODIFIED else parse(wanted.model, answer)
                self._encoder.store(uav_id, step, resource, answer.headers.get("ETag"))
        except (EdgeError, ValueError):
            pass
        return fetched

    async def _call(self, method: str, path: str, model: type[Answer], body: BaseModel | None = None) -> Answer:
        content = None if body is None else body.model_dump_json().encode()
        answer, _ = await self._requests.exchange(Send(method, path, content))
        return parse(model, answer)


def _encoder_of(uplink: Uplink) -> FullReports:
    if uplink == "pruned":
        # The features take a while to import, and only this uplink needs them.
        from shared.client.pruned_reports import PrunedReports

        return PrunedReports()
    return DeltaReports() if uplink == "delta" else FullReports()
