"""Requests where one edge has several processes: each reaches the process that decides its mission.

A request about another process's mission moves there with its connection, by
:mod:`service.server.connection_handover`. Requests about the whole edge are answered for all its processes: each is
asked over its Unix socket, with the request's own key.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
from collections.abc import Callable

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.merging import DECIDED_AT, Answer, merged_metrics, merged_missions, merged_readiness
from service.api.problem_details import problem_response
from service.config.process_member import Member
from service.errors import Elsewhere
from service.server.connection_handover import ARRIVED, CONNECTION, MovableHttpProtocol, Mover, request_bytes

log = logging.getLogger(__name__)

# The longest wait for another process's answer: one that is paused counts as away.
_ASKED_S = 2.0
# A mission's ID in a request that names one, as far as it can be seen without parsing the request.
_IN_PATH = re.compile(r"/missions/([A-Za-z0-9][A-Za-z0-9._-]{0,63})(?:/|$)")
_IN_BODY = re.compile(rb'"mission_id"\s*:\s*"([A-Za-z0-9][A-Za-z0-9._-]{0,63})"')
_DECIDE = ("/decide", "/decide/batch")
_PASSED_ON = (b"authorization", b"content-type", b"idempotency-key", b"accept-encoding", b"if-none-match")


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
        return merged_metrics({str(slot): answer for slot, answer in answers.items()}, own)

    def _readiness(self, answers: dict[int, Answer], own: Answer) -> Response:
        away = [slot for slot in range(self._member.slots) if slot not in answers]
        detail = f"process {away[0]} of {self._member.slots} is away" if away else None
        return merged_readiness(answers.values(), detail)

    def _missions(self, answers: dict[int, Answer], own: Answer) -> Response:
        return merged_missions(answers.values(), own)

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
            message = {**message, "headers": [*message["headers"], (DECIDED_AT.encode(), repr(at).encode())]}
        await send(message)

    return dated
