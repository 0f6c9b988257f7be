"""The UAVs' side of the wire: one edge, asked over HTTP, with bounded retries and a clock."""

from __future__ import annotations

import math
import random
import time
import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Self, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from shared.guidance import GuidanceAnswer, GuidanceStatus
from shared.wire import (
    MAX_ROUND_TRIP_MS,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    MissionSpec,
    MissionStatus,
    Outcome,
    Problem,
    Readiness,
)

RETRIED_STATUS = frozenset({429, 502, 503, 504})
FIRST_BACKOFF_S = 0.1
LONGEST_BACKOFF_S = 2.0
LONGEST_RETRY_AFTER_S = 5.0
POLL_S = 0.5

Answer = TypeVar("Answer", bound=BaseModel)


class EdgeError(Exception):
    """The edge gave no usable answer."""


class EdgeUnreachable(EdgeError):
    """Every attempt failed on the way, or the edge was too busy each time; the text names the URL and the cause."""


class EdgeRefused(EdgeError):
    """The edge answered, and the answer was no.

    ``status`` is the HTTP status, ``detail`` the problem's own words, ``errors`` its fields at fault.
    """

    def __init__(self, url: str, status: int, detail: str, errors: list[dict[str, str]] | None = None) -> None:
        self.status = status
        self.detail = detail
        self.errors = errors or []
        fields = "; ".join(": ".join(error.values()) for error in self.errors)
        super().__init__(f"{url} refused with {status}: {detail}" + (f" ({fields})" if fields else ""))

    def blames(self, field: str) -> bool:
        """Whether the problem's fields or detail name ``field``."""
        return field in self.detail or any(field in value for error in self.errors for value in error.values())


class EdgeProtocolError(EdgeError):
    """Something answered with success, and the answer is not what an AIC-VDS edge says."""


@dataclass(frozen=True)
class Exchange:
    """One decision and what it took: milliseconds from the first attempt to the answer, retries included,
    and the bytes of the request's body (of one attempt) and of the answer's."""

    response: DecideResponse
    rtt_ms: float
    attempts: int
    request_bytes: int
    response_bytes: int

    def outcome(self, cost: float, failed: bool) -> Outcome:
        """What came of the decision, to be told with this UAV's next request."""
        round_trip_ms = min(round(self.rtt_ms, 3), MAX_ROUND_TRIP_MS)
        decision_id = self.response.decision_id
        return Outcome(decision_id=decision_id, cost=cost, failed=failed, round_trip_ms=round_trip_ms)


def edge_url(text: str) -> str:
    """The edge's base URL, without a trailing slash.

    Raises:
        ValueError: it is no http or https URL with a host, or it carries a password.
    """
    try:
        url = httpx.URL(text)
    except httpx.InvalidURL as error:
        raise ValueError(f"{text!r} is not a URL: {error}") from None
    if url.scheme not in ("http", "https") or not url.host:
        raise ValueError(f"{text!r} is not an edge's URL; write it like http://127.0.0.1:8000")
    if url.userinfo or url.query or url.fragment:
        # The URL goes into summary.json and the report; a secret must not.
        raise ValueError("an edge's URL carries no user, password, query or fragment; set AICVDS_API_KEY for a key")
    return str(url).rstrip("/")


class EdgeClient:
    """A synchronous client of one edge; use it as a context manager.

    Connection errors, timeouts and 429/502/503/504 are tried again, ``attempts`` times in all, after a
    random pause of at most 0.1 s, doubled each time up to 2 s; a ``Retry-After`` is honoured up to 5 s.
    ``timeout_s`` bounds each wait for the network within one attempt. ``transport`` replaces the network
    (see ``simulator.uplink``); ``seed`` fixes the pauses' draws.

    Raises (every method):
        EdgeUnreachable: no attempt got through.
        EdgeRefused: the edge answered with an error that another attempt would not mend.
        EdgeProtocolError: what answered is no AIC-VDS edge.
    """

    def __init__(
        self,
        base_url: str,
        *,
        timeout_s: float,
        attempts: int = 3,
        api_key: str | None = None,
        seed: int = 0,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        if attempts < 1 or not timeout_s > 0:
            raise ValueError(f"attempts must be at least 1 and timeout_s positive, not {attempts} and {timeout_s}")
        self.base_url = edge_url(base_url)
        self._attempts = attempts
        self._random = random.Random(f"backoff-{seed}")
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        if api_key is not None:
            headers["Authorization"] = f"Bearer {api_key}"
        # A proxy named in the environment cannot reach an edge on this machine's loopback.
        local = httpx.URL(self.base_url).host in ("localhost", "127.0.0.1", "::1")
        self._http = httpx.Client(headers=headers, timeout=timeout_s, transport=transport, trust_env=not local)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def wait_ready(
        self,
        timeout_s: float,
        wait_out: Collection[str] = ("loading",),
        on_wait: Callable[[str], None] | None = None,
    ) -> Readiness:
        """Poll ``/readyz`` until the edge can decide and its LLM's state is none of ``wait_out``.

        After ``timeout_s`` seconds an edge that decides is returned as it is. ``on_wait`` hears, before each pause,
        what is being waited for.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            readiness: Readiness | None = None
            try:
                readiness = self._parse(Readiness, self._once("GET", "/readyz"), "/readyz")
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
            time.sleep(min(POLL_S, left))

    def put_mission(self, mission_id: str, spec: MissionSpec) -> MissionStatus:
        """Make the mission at the edge."""
        path = f"/missions/{mission_id}"
        answer, _ = self._exchange("PUT", path, spec)
        return self._parse(MissionStatus, answer, path)

    def guidance(self, mission_id: str) -> GuidanceStatus:
        """What the edge understood of the operator's note."""
        path = f"/missions/{mission_id}/guidance"
        answer, _ = self._exchange("GET", path, b"")
        return self._parse(GuidanceStatus, answer, path)

    def answer_guidance(self, mission_id: str, given: GuidanceAnswer) -> GuidanceStatus:
        """Confirm or reject it, or give a structure in its place."""
        path = f"/missions/{mission_id}/guidance"
        answer, _ = self._exchange("POST", path, given)
        return self._parse(GuidanceStatus, answer, path)

    def decide(self, request: DecideRequest, attempts: int | None = None) -> Exchange:
        """Ask for one decision, and time it; ``attempts`` overrides the client's."""
        body = request.model_dump_json().encode()
        began = time.perf_counter()
        # What is sent again, because its answer was lost on the way, gets that answer.
        answer, tried = self._exchange("POST", "/decide", body, attempts, {"Idempotency-Key": uuid.uuid4().hex})
        rtt_ms = (time.perf_counter() - began) * 1000
        response = self._parse(DecideResponse, answer, "/decide")
        if response.sensor_id not in request.sensors.id:
            raise EdgeProtocolError(f"{self.base_url}/decide chose sensor {response.sensor_id}, which was not offered")
        if (response.uav_id, response.step) != (request.uav_id, request.step):
            raise EdgeProtocolError(f"{self.base_url}/decide answered for another UAV or step")
        return Exchange(response, rtt_ms, tried, len(body), len(answer.content))

    def feedback(self, outcome: FeedbackRequest) -> FeedbackResponse:
        """Send an outcome on its own."""
        answer, _ = self._exchange("POST", "/feedback", outcome)
        return self._parse(FeedbackResponse, answer, "/feedback")

    def _exchange(
        self,
        method: str,
        path: str,
        body: BaseModel | bytes,
        attempts: int | None = None,
        headers: dict[str, str] | None = None,
    ) -> tuple[httpx.Response, int]:
        content = body if isinstance(body, bytes) else body.model_dump_json().encode()
        most = attempts or self._attempts
        for attempt in range(1, most + 1):
            try:
                return self._once(method, path, content, headers), attempt
            except _TryAgain as again:
                if attempt == most:
                    tries = "once" if attempt == 1 else f"{attempt} times"
                    raise EdgeUnreachable(f"{self.base_url}{path} was tried {tries}: {again.cause}") from again
                time.sleep(self._pause(attempt, again.retry_after_s))
        raise AssertionError("unreachable: attempts is at least 1")

    def _once(
        self, method: str, path: str, content: bytes | None = None, headers: dict[str, str] | None = None
    ) -> httpx.Response:
        try:
            answer = self._http.request(method, self.base_url + path, content=content, headers=headers)
        except httpx.TransportError as error:
            raise _TryAgain(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__) from error
        except httpx.DecodingError as error:
            raise EdgeProtocolError(f"{self.base_url}{path} answered with a broken body: {error}") from error
        if answer.status_code in RETRIED_STATUS:
            problem = _problem(answer)
            raise _TryAgain(f"{answer.status_code} {problem.detail}", _retry_after(answer))
        if answer.status_code >= 400:
            problem = _problem(answer)
            raise EdgeRefused(f"{self.base_url}{path}", answer.status_code, problem.detail, problem.errors)
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
    """A failure that another attempt may mend."""

    def __init__(self, cause: str, retry_after_s: float | None = None) -> None:
        super().__init__(cause)
        self.cause = cause
        self.retry_after_s = retry_after_s


def _problem(answer: httpx.Response) -> Problem:
    try:
        return Problem.model_validate_json(answer.content)
    except ValidationError:
        # A proxy's error page, say: its words are all there is, and the first line of them enough.
        words = answer.text.strip().splitlines()
        detail = words[0][:200] if words else answer.reason_phrase
        return Problem(title=answer.reason_phrase, status=answer.status_code, detail=detail)


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
