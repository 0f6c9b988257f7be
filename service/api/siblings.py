"""Requests where one edge has several processes: each reaches the process that decides its mission.

A request about another process's mission moves there with its connection (:mod:`service.server.moving`). Requests about
the whole edge are answered for all its processes: each is asked over its Unix socket, with the request's own key.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain, zip_longest

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.problem_details import problem_response
from service.config.processes import Member
from service.errors import Elsewhere
from service.observability.gathered import gathered
from service.server.moving import ARRIVED, CONNECTION, MovableHttpProtocol, Mover, request_bytes
from shared.missions import MissionList
from shared.wire import Readiness

log = logging.getLogger(__name__)

# The longest wait for another process's answer: one that is paused counts as away.
_ASKED_S = 2.0
# When the process's newest decision was, in its answer to another process.
_DECIDED_AT = "x-decided-at"
_MOST_LISTED = 200
# A mission's ID in a request that names one, as far as it can be seen without parsing the request.
_IN_PATH = re.compile(r"/missions/([A-Za-z0-9][A-Za-z0-9._-]{0,63})(?:/|$)")
_IN_BODY = re.compile(rb'"mission_id"\s*:\s*"([A-Za-z0-9][A-Za-z0-9._-]{0,63})"')
_DECIDE = ("/decide", "/decide/batch")
_PASSED_ON = (b"authorization", b"content-type", b"idempotency-key", b"accept-encoding", b"if-none-match")


@dataclass
class Answer:
    """An answer that is not sent yet."""

    status: int = 0
    headers: list[tuple[bytes, bytes]] = field(default_factory=list)
    body: bytes = b""

    async def send(self, message: Message) -> None:
        """Take a message of the application."""
        if message["type"] == "http.response.start":
            self.status, self.headers = message["status"], list(message.get("headers", ()))
        else:
            self.body += message.get("body", b"")

    async def forward(self, send: Send) -> None:
        """Send it."""
        await send({"type": "http.response.start", "status": self.status, "headers": self.headers})
        await send({"type": "http.response.body", "body": self.body})

    def header(self, name: str) -> str | None:
        """The value of a header in lower case."""
        return next((value.decode("latin-1") for key, value in self.headers if key.lower() == name.encode()), None)


class Siblings:
    """Pure ASGI middleware within :class:`RequestLimits`, which has read the body."""

    def __init__(self, app: ASGIApp, member: Member) -> None:
        self.app = app
        self._member = member
        self._mover = Mover(member)
        self._merged: dict[tuple[str, str], Callable[[dict[int, Answer], Answer], Response]] = {
            ("GET", "/metrics"): self._metrics,
            ("GET", "/readyz"): self._readiness,
            ("GET", "/missions"): self._missions,
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        waiting: list[Message] = []
        if scope["method"] in ("POST", "PUT"):
            waiting.append(await receive())
        body: bytes = waiting[0].get("body", b"") if waiting else b""

        async def replayed() -> Message:
            return waiting.pop() if waiting else await receive()

        try:
            other = self._other(scope, body)
            if other is not None:
                raise Elsewhere(other)
            await self._answer(scope, body, replayed, send)
        except Elsewhere as elsewhere:
            await self._send_there(elsewhere.slot, scope, body, replayed, send)

    def _other(self, scope: Scope, body: bytes) -> int | None:
        """The process of the mission that a request seems to name, unless it is this one: parsing it would take longer.

        The edge itself knows better. So a request that has already moved, perhaps wrongly, is left to it.
        """
        if scope.get(ARRIVED):
            return None
        found = _IN_PATH.match(scope["path"])
        if found is not None:
            name = found[1]
        elif scope["path"] in _DECIDE:
            mission_id = _IN_BODY.search(body)
            name = "default" if mission_id is None else mission_id[1].decode()
        else:
            return None
        return None if self._member.decides(name) else self._member.slot_of(name)

    async def _answer(self, scope: Scope, body: bytes, receive: Receive, send: Send) -> None:
        """The answer of this process, or of all."""
        request = scope["method"], scope["path"]
        if _asked_by_sibling(scope):
            await self.app(scope, receive, _dated(scope, send) if request == ("GET", "/missions") else send)
        elif request in self._merged:
            await self._merge(scope, receive, send)
        elif request == ("POST", "/feedback"):
            own = Answer()
            await self.app(scope, receive, own.send)
            await (await self._known(own, scope, body)).forward(send)
        else:
            await self.app(scope, receive, send)

    async def _send_there(self, slot: int, scope: Scope, body: bytes, receive: Receive, send: Send) -> None:
        """Give the connection with the request to another process; without it, pass the request and its answer on."""
        connection: MovableHttpProtocol | None = scope.get(CONNECTION)
        if connection is not None and connection.movable:
            if await self._mover.move(connection, slot, request_bytes(scope, body)):
                # The server must know that the connection has gone before this returns without an answer.
                while (await receive())["type"] != "http.disconnect":
                    pass
                return
        elif (answer := await self._ask(slot, scope, body)) is not None:
            await answer.forward(send)
            return
        response = problem_response(503, "the process of this edge that decides the mission is away: send it again")
        response.headers["Retry-After"] = "1"
        await response(scope, receive, send)

    async def _merge(self, scope: Scope, receive: Receive, send: Send) -> None:
        own = Answer()
        asking = asyncio.gather(*(self._ask(slot, scope, b"") for slot in self._member.others))
        await self.app(scope, receive, _dated(scope, own.send) if scope["path"] == "/missions" else own.send)
        answers = {self._member.slot: own}
        for slot, answer in zip(self._member.others, await asking, strict=True):
            if answer is not None:
                answers[slot] = answer
        await self._merged[scope["method"], scope["path"]](dict(sorted(answers.items())), own)(scope, receive, send)

    def _metrics(self, answers: dict[int, Answer], own: Answer) -> Response:
        texts = {slot: answer.body.decode() for slot, answer in answers.items() if answer.status == 200}
        return Response(gathered(texts), media_type=own.header("content-type"))

    def _readiness(self, answers: dict[int, Answer], own: Answer) -> Response:
        """Ready where all are; its LLM is ready where all have reached it."""
        found = [Readiness.model_validate_json(a.body) for a in answers.values() if a.status in (200, 503)]
        shown = min(found, key=lambda one: (one.ready, one.llm == "ready"))
        if away := [slot for slot in range(self._member.slots) if slot not in answers]:
            detail = f"process {away[0]} of {self._member.slots} is away"
            shown = shown.model_copy(update={"ready": False, "detail": detail})
        return Response(shown.model_dump_json(), 200 if shown.ready else 503, media_type="application/json")

    def _missions(self, answers: dict[int, Answer], own: Answer) -> Response:
        """The missions of all, each process's in its order, one of each in turn: the one that decided last first."""
        listed = [answer for answer in answers.values() if answer.status == 200]
        listed.sort(key=lambda answer: -float(answer.header(_DECIDED_AT) or 0.0))
        lists = [MissionList.model_validate_json(answer.body) for answer in listed]
        lines = [line for line in chain.from_iterable(zip_longest(*(one.missions for one in lists))) if line]
        more = sum(one.more for one in lists) + max(0, len(lines) - _MOST_LISTED)
        newest = next((one.newest for one in lists if one.newest is not None), None)
        may_command = MissionList.model_validate_json(own.body).may_command
        merged = MissionList(missions=lines[:_MOST_LISTED], more=more, newest=newest, may_command=may_command)
        return Response(merged.model_dump_json(), media_type="application/json")

    async def _known(self, own: Answer, scope: Scope, body: bytes) -> Answer:
        """The answer to an outcome: where it names no mission, of the process that knows its decision."""
        if own.status != 404 or json.loads(body).get("mission_id") is not None:
            return own
        for slot in self._member.others:
            answer = await self._ask(slot, scope, body)
            if answer is not None and answer.status != 404:
                return answer
        return own

    async def _ask(self, slot: int, scope: Scope, body: bytes) -> Answer | None:
        """Another process's answer to a request; None where it is away."""
        # It takes a fifth of a second to import, which an edge's start need not wait for.
        import aiohttp
        from yarl import URL

        target = scope["raw_path"].decode() + ("?" + scope["query_string"].decode() if scope["query_string"] else "")
        headers = [(n.decode(), v.decode("latin-1")) for n, v in scope["headers"] if n in _PASSED_ON]
        connector = aiohttp.UnixConnector(self._member.requests_of(slot))
        limit = aiohttp.ClientTimeout(total=_ASKED_S)
        try:
            async with (
                aiohttp.ClientSession(connector=connector, timeout=limit, auto_decompress=False) as session,
                session.request(
                    scope["method"], URL(f"http://edge{target}", encoded=True), headers=headers, data=body or None
                ) as response,
            ):
                kept = [(n.lower(), v) for n, v in response.raw_headers if n.lower() not in _FRAMING]
                found = await response.read()
                return Answer(response.status, [*kept, (b"content-length", str(len(found)).encode())], found)
        except (aiohttp.ClientError, TimeoutError, OSError) as error:
            log.warning("process %d of this edge does not answer: %s", slot, repr(error))
            return None


_FRAMING = (b"content-length", b"transfer-encoding", b"connection", b"date")


def _asked_by_sibling(scope: Scope) -> bool:
    """Whether the request came over the Unix socket: such an address has no port."""
    return scope["server"] is not None and scope["server"][1] is None


def _dated(scope: Scope, send: Send) -> Send:
    """Add when the newest decision was made, so that the process that asks knows whose was the last."""

    async def dated(message: Message) -> None:
        if message["type"] == "http.response.start":
            at: float = scope["state"]["engine"].live.history.decided_at
            message = {**message, "headers": [*message["headers"], (_DECIDED_AT.encode(), repr(at).encode())]}
        await send(message)

    return dated
