"""The calls to an edge: requests, retries and checks of the answers, without network or waiting.

A call is a generator. It yields a :class:`Send` or a :class:`Pause`. Its runner, a client, carries that out and sends
the HTTP response into the generator, or throws the ``httpx`` error. The generator returns the result of the call. The
synchronous and the asynchronous client of :mod:`shared.client` therefore differ only in how they wait.
"""

from __future__ import annotations

import math
import random
import time
import uuid
from collections.abc import Callable, Collection, Generator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from shared.client.encoder_choice import encoder_of
from shared.client.errors import EdgeAddressWrong, EdgeError, EdgeProtocolError, EdgeRefused, EdgeUnreachable
from shared.planning.orders import GuidanceAnswer, GuidanceStatus
from shared.wire.missions import MissionStatus
from shared.wire.problem import INCOMPLETE, Problem
from shared.wire.readings import ReadingsRequest, ReadingsResponse
from shared.wire.schemas import (
    MAX_ROUND_TRIP_MS,
    BatchRequest,
    BatchResponse,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    MissionSpec,
    Outcome,
    Readiness,
    UavState,
    Uplink,
)

RETRIED_STATUS = frozenset({408, 429, 502, 503, 504})
FIRST_BACKOFF_S = 0.1
LONGEST_BACKOFF_S = 2.0
LONGEST_RETRY_AFTER_S = 5.0
POLL_S = 0.5
NOT_MODIFIED = 304
MISDIRECTED = 421
Answer = TypeVar("Answer", bound=BaseModel)
Result = TypeVar("Result")


@dataclass(frozen=True)
class Send:
    """One HTTP request, sent once; to another edge than the client's if ``base_url`` names one."""

    method: str
    path: str
    content: bytes | None = None
    headers: dict[str, str] | None = None
    base_url: str | None = None


@dataclass(frozen=True)
class Pause:
    """A wait of so many seconds."""

    seconds: float


Call = Generator[Send | Pause, httpx.Response | None, Result]


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
        decision_id = self.response.decision_id
        return Outcome(decision_id=decision_id, cost=cost, failed=failed, round_trip_ms=round_trip_ms)


def edge_url(text: str) -> str:
    """The edge's base URL, without a trailing slash.

    Raises:
        EdgeAddressWrong: it is no http or https URL with a host, or it has a password.
    """
    try:
        url = httpx.URL(text)
    except httpx.InvalidURL as error:
        raise EdgeAddressWrong(f"{text!r} is not a URL: {error}") from None
    if url.scheme not in ("http", "https") or not url.host:
        raise EdgeAddressWrong(f"{text!r} is not an edge's URL; write it like http://127.0.0.1:8000")
    if url.userinfo or url.query or url.fragment:
        # The URL goes into summary.json and the report; a secret must not.
        raise EdgeAddressWrong("an edge's URL has no user, password, query or fragment; set AICVDS_API_KEY for a key")
    return str(url).rstrip("/")


class Calls:
    """The calls to one edge.

    ``attempts`` is the number of attempts of each call, ``seed`` fixes the draws of the pauses, and ``uplink`` selects
    the encoder of the reports.

    Raises:
        ValueError: ``base_url`` is no edge's URL (see :func:`edge_url`), or ``attempts`` is below 1.
    """

    def __init__(self, base_url: str, attempts: int, seed: int, uplink: Uplink) -> None:
        if attempts < 1:
            raise ValueError(f"attempts must be at least 1, not {attempts}")
        self.base_url = edge_url(base_url)
        self._attempts = attempts
        self._random = random.Random(f"backoff-{seed}")
        self._encoder = encoder_of(uplink)
        # Reduced reports omit fields at their defaults too.
        self._terse = uplink != "full"

    def wait_ready(
        self, timeout_s: float, wait_out: Collection[str], on_wait: Callable[[str], None] | None
    ) -> Call[Readiness]:
        """Poll ``/readyz``."""
        deadline = time.monotonic() + timeout_s
        while True:
            readiness: Readiness | None = None
            try:
                readiness = self._parse(Readiness, (yield from self._once(Send("GET", "/readyz"))), "/readyz")
                state = f"the LLM is {readiness.llm}" if readiness.ready else "not ready"
                cause = f"{state}: {readiness.detail}" if readiness.detail else state
            except _TryAgain as again:
                cause = again.cause
            if readiness is not None and readiness.ready and readiness.llm not in wait_out:
                return readiness
            left = deadline - time.monotonic()
            if left <= 0:
                if readiness is not None and readiness.ready:
                    return readiness
                raise EdgeUnreachable(f"no edge is ready at {self.base_url} after {timeout_s:g} s: {cause}")
            if on_wait is not None:
                on_wait(cause)
            yield Pause(min(POLL_S, left))

    def put_mission(self, mission_id: str, spec: MissionSpec) -> Call[MissionStatus]:
        """``PUT /missions/{id}``."""
        return self._request("PUT", f"/missions/{mission_id}", MissionStatus, spec)

    def mission(self, mission_id: str) -> Call[MissionStatus]:
        """``GET /missions/{id}``."""
        return self._request("GET", f"/missions/{mission_id}", MissionStatus)

    def delete_mission(self, mission_id: str) -> Call[None]:
        """``DELETE /missions/{id}``."""
        yield from self._exchange(Send("DELETE", f"/missions/{mission_id}"))

    def guidance(self, mission_id: str) -> Call[GuidanceStatus]:
        """``GET /missions/{id}/guidance``."""
        return self._request("GET", f"/missions/{mission_id}/guidance", GuidanceStatus)

    def answer_guidance(self, mission_id: str, given: GuidanceAnswer) -> Call[GuidanceStatus]:
        """``POST /missions/{id}/guidance``."""
        return self._request("POST", f"/missions/{mission_id}/guidance", GuidanceStatus, given)

    def read(self, mission_id: str, readings: ReadingsRequest) -> Call[ReadingsResponse]:
        """``POST /missions/{id}/readings``."""
        return self._request("POST", f"/missions/{mission_id}/readings", ReadingsResponse, readings)

    def feedback(self, outcome: FeedbackRequest) -> Call[FeedbackResponse]:
        """``POST /feedback``."""
        return self._request("POST", "/feedback", FeedbackResponse, outcome)

    def decide(self, request: DecideRequest, attempts: int | None) -> Call[Exchange]:
        """``POST /decide``, timed."""
        mission_id, step = request.mission_id, request.step
        fetched = yield from self._refresh(mission_id, step, request.uav_id)
        began = time.perf_counter()
        answer, tried, sent = yield from self._decided(
            "/decide", [request], lambda: self._encoder.reduced(mission_id, step, request), attempts
        )
        rtt_ms = (time.perf_counter() - began) * 1000
        response = self._parse(DecideResponse, answer, "/decide")
        self._check(response, request, step, "/decide")
        return Exchange(response, rtt_ms, tried, sent, len(answer.content), fetched)

    def decide_batch(self, request: BatchRequest) -> Call[BatchResponse]:
        """``POST /decide/batch``."""
        mission_id, step = request.mission_id, request.step
        for uav in request.uavs:
            yield from self._refresh(mission_id, step, uav.uav_id)

        def reduced() -> BatchRequest:
            uavs = [self._encoder.reduced(mission_id, step, uav) for uav in request.uavs]
            return request.model_copy(update={"uavs": uavs})

        answer, _, _ = yield from self._decided("/decide/batch", request.uavs, reduced, None)
        batch = self._parse(BatchResponse, answer, "/decide/batch")
        if len(batch.decisions) != len(request.uavs):
            raise EdgeProtocolError(f"{self.base_url}/decide/batch left a UAV without a decision")
        for response, uav in zip(batch.decisions, request.uavs, strict=True):
            self._check(response, uav, step, "/decide/batch")
        return batch

    def _refresh(self, mission_id: str, step: int, uav_id: int) -> Call[int]:
        """Fetch the resources that the uplink's encoder needs; returns the bytes fetched.

        After a failed fetch, the encoder works with the resources that it has.
        """
        fetched = 0
        try:
            while (wanted := self._encoder.missing(mission_id, step, uav_id)) is not None:
                headers = None if wanted.etag is None else {"If-None-Match": wanted.etag}
                answer, _ = yield from self._exchange(Send("GET", wanted.path, headers=headers), attempts=1)
                fetched += answer.num_bytes_downloaded
                unchanged = answer.status_code == NOT_MODIFIED
                resource = None if unchanged else self._parse(wanted.model, answer, wanted.path)
                self._encoder.take(uav_id, step, resource, answer.headers.get("ETag"))
        except (EdgeError, ValueError):
            # A failed fetch must not fail the decision.
            return fetched
        return fetched

    def _decided(
        self, path: str, uavs: Sequence[UavState], reduced: Callable[[], BaseModel], attempts: int | None
    ) -> Call[tuple[httpx.Response, int, int]]:
        """The answer, the number of attempts, and the bytes sent: of both bodies if the edge needs the full report."""
        send = self._deciding(path, reduced())
        try:
            answer, tried = yield from self._exchange(send, attempts)
            return answer, tried, len(send.content or b"")
        except EdgeRefused as refused:
            if refused.type != INCOMPLETE:
                raise
        for uav in uavs:
            self._encoder.forget(uav.uav_id)
        whole = self._deciding(path, reduced())
        answer, tried = yield from self._exchange(whole, attempts)
        return answer, 1 + tried, len(send.content or b"") + len(whole.content or b"")

    def _deciding(self, path: str, request: BaseModel) -> Send:
        # A retry with the same key after a lost response gets that response.
        body = request.model_dump_json(exclude_defaults=self._terse).encode()
        return Send("POST", path, body, {"Idempotency-Key": uuid.uuid4().hex})

    def _check(self, response: DecideResponse, uav: UavState, step: int, path: str) -> None:
        if response.sensor_id not in uav.sensors.id:
            raise EdgeProtocolError(f"{self.base_url}{path} chose sensor {response.sensor_id}, which was not offered")
        if (response.uav_id, response.step) != (uav.uav_id, step):
            raise EdgeProtocolError(f"{self.base_url}{path} answered for another UAV or step")
        self._encoder.answered(uav, response)

    def _request(self, method: str, path: str, model: type[Answer], body: BaseModel | None = None) -> Call[Answer]:
        content = None if body is None else body.model_dump_json().encode()
        answer, _ = yield from self._exchange(Send(method, path, content))
        return self._parse(model, answer, path)

    def _exchange(self, send: Send, attempts: int | None = None) -> Call[tuple[httpx.Response, int]]:
        most = attempts or self._attempts
        for attempt in range(1, most + 1):
            try:
                return (yield from self._once(send)), attempt
            except _TryAgain as again:
                if attempt == most:
                    tries = "once" if attempt == 1 else f"{attempt} times"
                    raise EdgeUnreachable(f"{self.base_url}{send.path} was tried {tries}: {again.cause}") from again
                pause = self._pause(attempt, again.retry_after_s)
            yield Pause(pause)
        raise AssertionError("unreachable: attempts is at least 1")

    def _once(self, send: Send) -> Call[httpx.Response]:
        """Send a request, and send it again to the edge that has the mission, where the answer names one."""
        try:
            return (yield from self._at_one_edge(send))
        except _Misdirected as elsewhere:
            owner, retry_after_s = elsewhere.owner, elsewhere.retry_after_s
        if owner is None:
            raise _TryAgain("another edge has the mission, and gave no address", retry_after_s)
        try:
            return (yield from self._at_one_edge(replace(send, base_url=owner)))
        except _Misdirected as again:
            raise _TryAgain(f"neither this edge nor {owner} has the mission", again.retry_after_s) from None
        except _TryAgain as again:
            # An owner that has ended keeps its missions from other edges until their leases end.
            raise _TryAgain(f"{owner}: {again.cause}", again.retry_after_s or retry_after_s) from again

    def _at_one_edge(self, send: Send) -> Call[httpx.Response]:
        url = (send.base_url or self.base_url) + send.path
        try:
            answer = yield send
        except httpx.TransportError as error:
            raise _TryAgain(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__) from error
        except httpx.DecodingError as error:
            raise EdgeProtocolError(f"{url} answered with a broken body: {error}") from error
        assert answer is not None, "the runner of a call answers a Send with the response"
        if answer.status_code == MISDIRECTED:
            raise _Misdirected(_owner(answer), _retry_after(answer))
        if answer.status_code in RETRIED_STATUS:
            raise _TryAgain(f"{answer.status_code} {_problem(answer).detail}", _retry_after(answer))
        if answer.status_code >= 400 and _is_page(answer):
            what = f"it answers {answer.status_code} with a web page to {send.path}"
            raise EdgeProtocolError(f"there is no AIC-VDS edge at {url.removesuffix(send.path)}: {what}")
        if answer.status_code >= 400:
            raise EdgeRefused(url, _problem(answer), answer.status_code)
        return answer

    def _parse(self, model: type[Answer], answer: httpx.Response, path: str) -> Answer:
        if not answer.is_success:
            raise EdgeProtocolError(f"{self.base_url}{path} answered {answer.status_code}; is that an AIC-VDS edge?")
        try:
            return model.model_validate_json(answer.content)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "the body"
            raise EdgeProtocolError(
                f"{self.base_url}{path} answered {answer.status_code} with no {model.__name__}: {where}: {first['msg']}"
            ) from None

    def _pause(self, attempt: int, retry_after_s: float | None) -> float:
        if retry_after_s is not None:
            return min(retry_after_s, LONGEST_RETRY_AFTER_S)
        return self._random.uniform(0, min(LONGEST_BACKOFF_S, FIRST_BACKOFF_S * 2 ** (attempt - 1)))


class _TryAgain(Exception):
    """A failure that a retry may cure."""

    def __init__(self, cause: str, retry_after_s: float | None = None) -> None:
        super().__init__(cause)
        self.cause = cause
        self.retry_after_s = retry_after_s


class _Misdirected(Exception):
    """The mission belongs to another edge, at ``owner`` if that is known."""

    def __init__(self, owner: str | None, retry_after_s: float | None) -> None:
        super().__init__(owner)
        self.owner = owner
        self.retry_after_s = retry_after_s


def _owner(answer: httpx.Response) -> str | None:
    owner = _problem(answer).owner
    try:
        return None if owner is None else edge_url(owner)
    except EdgeAddressWrong:
        return None


def _problem(answer: httpx.Response) -> Problem:
    try:
        return Problem.model_validate_json(answer.content)
    except ValidationError:
        # Such as a proxy's error page: its first line is the detail.
        lines = answer.text.strip().splitlines()
        detail = lines[0][:200] if lines else answer.reason_phrase
        return Problem(title=answer.reason_phrase, status=answer.status_code, detail=detail)


def _is_page(answer: httpx.Response) -> bool:
    """Whether the answer is a web page, as another server's or a proxy's."""
    return answer.text.lstrip()[:1] == "<"


def _retry_after(answer: httpx.Response) -> float | None:
    text = answer.headers.get("Retry-After")
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        try:
            when = parsedate_to_datetime(text)
        except ValueError:
            return None
        seconds = (when.replace(tzinfo=when.tzinfo or UTC) - datetime.now(UTC)).total_seconds()
    return max(0.0, seconds) if math.isfinite(seconds) else None
