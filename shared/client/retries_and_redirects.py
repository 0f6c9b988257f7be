"""Requests to an edge: retried where a retry can help, and sent on to the edge that has the mission.

A request waits only in the two functions given to :class:`Requests`: the asynchronous client gives those of an event
loop, and the blocking client functions that never suspend.
"""

import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from shared.client.errors import EdgeProtocolError, EdgeRefused, EdgeUnreachable, InvalidEdgeUrl
from shared.kit.retry_after import asked_pause_s
from shared.wire.problem import Problem

RETRIED_STATUS = frozenset({408, 429, 502, 503, 504})
FIRST_BACKOFF_S, LONGEST_BACKOFF_S = 0.1, 2.0
LONGEST_RETRY_AFTER_S = 5.0
NOT_MODIFIED, MISDIRECTED = 304, 421
Answer = TypeVar("Answer", bound=BaseModel)
Sleep = Callable[[float], Awaitable[None]]


def edge_url(text: str) -> str:
    """The edge's base URL, without a trailing slash.

    Raises:
        InvalidEdgeUrl: it is no http or https URL with a host, or it has a password.
    """
    try:
        url = httpx.URL(text)
    except httpx.InvalidURL as error:
        raise InvalidEdgeUrl(f"{text!r} is not a URL: {error}") from None
    if url.scheme not in ("http", "https") or not url.host:
        raise InvalidEdgeUrl(f"{text!r} is not an edge's URL; write it like http://127.0.0.1:8000")
    if url.userinfo or url.query or url.fragment:
        # The URL goes into summary.json and the report; a secret must not.
        raise InvalidEdgeUrl("an edge's URL has no user, password, query or fragment; set AICVDS_API_KEY for a key")
    return str(url).rstrip("/")


class TryAgain(Exception):
    """A failure that a retry may cure."""

    def __init__(self, cause: str, retry_after_s: float | None = None) -> None:
        super().__init__(cause)
        self.cause = cause
        self.retry_after_s = retry_after_s


@dataclass(frozen=True)
class Send:
    """What a request sends, to whichever edge."""

    method: str
    path: str
    content: bytes | None = None
    headers: dict[str, str] | None = None


class Requests:
    """Requests to the edge at ``base_url``.

    Args:
        base_url: see :func:`edge_url`.
        request: as ``httpx.AsyncClient.request``.
        sleep: as ``asyncio.sleep``.
        attempts: of each request, unless it says otherwise.
        seed: of the draws of the pauses.

    Raises:
        ValueError: ``base_url`` is no edge's URL, or ``attempts`` is below 1.
    """

    def __init__(
        self, base_url: str, request: Callable[..., Awaitable[httpx.Response]], sleep: Sleep, attempts: int, seed: int
    ) -> None:
        if attempts < 1:
            raise ValueError(f"attempts must be at least 1, not {attempts}")
        self.base_url = edge_url(base_url)
        self._request, self._sleep = request, sleep
        self._attempts, self._random = attempts, random.Random(f"backoff-{seed}")

    async def exchange(self, send: Send, attempts: int | None = None) -> tuple[httpx.Response, int]:
        """The answer, and the number of attempts.

        Raises:
            EdgeUnreachable: no attempt succeeded.
            EdgeRefused: the edge answered with an error that a retry cannot cure.
            EdgeProtocolError: the server is no AIC-VDS edge.
        """
        attempts, attempt = attempts or self._attempts, 1
        while True:
            try:
                return await self.attempt(send), attempt
            except TryAgain as again:
                if attempt == attempts:
                    tries = "once" if attempt == 1 else f"{attempt} times"
                    raise EdgeUnreachable(f"{self.base_url}{send.path} was tried {tries}: {again.cause}") from again
                asked_s = again.retry_after_s
            limit_s = min(LONGEST_BACKOFF_S, FIRST_BACKOFF_S * 2 ** (attempt - 1))
            await self._sleep(
                self._random.uniform(0, limit_s) if asked_s is None else min(asked_s, LONGEST_RETRY_AFTER_S)
            )
            attempt += 1

    async def attempt(self, send: Send) -> httpx.Response:
        """Send once, and once more to the edge that has the mission, where the answer names one.

        Raises:
            TryAgain: a retry may help.
            EdgeRefused, EdgeProtocolError: as above.
        """
        answer = await self._send(self.base_url, send)
        if answer.status_code != MISDIRECTED:
            return answer
        owner, retry_after_s = _owner(answer), asked_pause_s(answer.headers)
        if owner is None:
            raise TryAgain("another edge has the mission, and gave no address", retry_after_s)
        try:
            answer = await self._send(owner, send)
        except TryAgain as again:
            # An owner that has ended keeps its missions from other edges until their leases end.
            raise TryAgain(f"{owner}: {again.cause}", again.retry_after_s or retry_after_s) from again
        if answer.status_code == MISDIRECTED:
            raise TryAgain(f"neither this edge nor {owner} has the mission", asked_pause_s(answer.headers))
        return answer

    async def _send(self, base_url: str, send: Send) -> httpx.Response:
        """The answer of one edge: a success, a redirect, or 421 where another edge has the mission."""
        url = base_url + send.path
        try:
            answer = await self._request(send.method, url, content=send.content, headers=send.headers)
        except httpx.TransportError as error:
            raise TryAgain(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__) from error
        except httpx.DecodingError as error:
            raise EdgeProtocolError(f"{url} answered with a broken body: {error}") from error
        status = answer.status_code
        if status in RETRIED_STATUS:
            raise TryAgain(f"{status} {_problem(answer).detail}", asked_pause_s(answer.headers))
        if status < 300 or status in (NOT_MODIFIED, MISDIRECTED):
            return answer
        if status < 400 or answer.text.lstrip()[:1] == "<":
            page = "a redirect" if status < 400 else "a web page"
            raise EdgeProtocolError(f"there is no AIC-VDS edge at {base_url}: {send.path} answers {status}, {page}")
        raise EdgeRefused(url, _problem(answer), status)


def parse(model: type[Answer], answer: httpx.Response) -> Answer:
    """The answer's body as that model; raises ``EdgeProtocolError`` if it is none."""
    if not answer.is_success:
        raise EdgeProtocolError(f"{answer.url} answered {answer.status_code}; is that an AIC-VDS edge?")
    try:
        # A later version of the edge may have further fields.
        return model.model_validate_json(answer.content, extra="ignore")
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the body"
        text = f"{answer.url} answered {answer.status_code} with no {model.__name__}: {where}: {first['msg']}"
        raise EdgeProtocolError(text) from None


def _owner(answer: httpx.Response) -> str | None:
    owner = _problem(answer).owner
    try:
        return None if owner is None else edge_url(owner)
    except InvalidEdgeUrl:
        return None


def _problem(answer: httpx.Response) -> Problem:
    try:
        return Problem.model_validate_json(answer.content)
    except ValidationError:
        # Such as a proxy's error page: its first line is the detail.
        lines = answer.text.strip().splitlines()
        detail = lines[0][:200] if lines else answer.reason_phrase
        return Problem(title=answer.reason_phrase, status=answer.status_code, detail=detail)
