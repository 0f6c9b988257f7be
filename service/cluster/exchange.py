"""Requests and answers between the ingress and the owners of missions, and the routing of requests."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope

from service.cluster.merging import Answer

# Routes whose body names the mission, `default` unless it says otherwise.
_BY_BODY = frozenset(("/decide", "/decide/batch", "/feedback"))
_DEFAULT = "default"
_EVENTS = re.compile(r"/missions/[^/]+/events")
# The longest deadline of a request.
_LONGEST_MS = 60_000
# The entries of an ASGI scope that an application reads, apart from its own.
_SENT = ("type", "http_version", "method", "scheme", "path", "raw_path", "query_string", "root_path", "headers")


@dataclass(frozen=True, slots=True)
class Exchanged:
    """A whole HTTP request: the ASGI scope's plain entries, and the decoded body."""

    scope: dict[str, Any]
    body: bytes

    @classmethod
    async def read(cls, scope: Scope, receive: Receive) -> Exchanged:
        """The request of an ASGI call, whose body is already bounded."""
        body = bytearray()
        while True:
            message = await receive()
            body += message.get("body", b"")
            if not message.get("more_body", False):
                return cls({name: scope[name] for name in _SENT if name in scope}, bytes(body))

    @property
    def mission_id(self) -> str | None:
        """The mission of the request; None if it names none or is malformed."""
        path: str = self.scope["path"]
        if self.lacks_mission:
            return None
        if path in _BY_BODY:
            return _named_in(self.body)
        _, _, rest = path.partition("/missions/")
        return rest.partition("/")[0] or None

    @property
    def lacks_mission(self) -> bool:
        """Whether it is an outcome without a mission ID, so that every edge is asked for its decision."""
        return self.scope["path"] == "/feedback" and _fields(self.body).get("mission_id") is None

    @property
    def asks_for_events(self) -> bool:
        """Whether its answer is a stream of events."""
        return self.scope["method"] == "GET" and _EVENTS.fullmatch(self.scope["path"]) is not None

    def deadline_s(self, default_s: float) -> float:
        """The client's deadline for the answer, seconds."""
        asked = _fields(self.body).get("deadline_ms") if self.scope["path"] in _BY_BODY else None
        return asked / 1e3 if isinstance(asked, int | float) and 0 < asked <= _LONGEST_MS else default_s


async def answer_of(app: ASGIApp, request: Exchanged) -> Answer:
    """The answer of an ASGI application."""
    pending: list[Message] = [{"type": "http.request", "body": request.body, "more_body": False}]
    answer = Answer(500)

    async def receive() -> Message:
        return pending.pop() if pending else {"type": "http.disconnect"}

    await app(dict(request.scope), receive, answer.send)
    return answer


def _fields(body: bytes) -> dict[str, Any]:
    try:
        found = json.loads(body)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _named_in(body: bytes) -> str | None:
    named = _fields(body).get("mission_id", _DEFAULT)
    return named if isinstance(named, str) else None
