"""A request and its answer on their way between the ingress and the owners of missions, and whom a request is for."""

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
# The longest that a request may give.
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
        """The request of an ASGI call, whose body somebody has bounded."""
        body = bytearray()
        while True:
            message = await receive()
            body += message.get("body", b"")
            if not message.get("more_body", False):
                return cls({name: scope[name] for name in _SENT if name in scope}, bytes(body))

    @property
    def mission_id(self) -> str | None:
        """The mission that the request is about; None where it names none, or is malformed."""
        path: str = self.scope["path"]
        if self.names_a_decision_alone:
            return None
        if path in _BY_BODY:
            return _named_in(self.body)
        _, _, rest = path.partition("/missions/")
        return rest.partition("/")[0] or None

    @property
    def names_a_decision_alone(self) -> bool:
        """Whether it is an outcome without a mission: the owner of its decision is to be found."""
        return self.scope["path"] == "/feedback" and _fields(self.body).get("mission_id") is None

    @property
    def asks_for_events(self) -> bool:
        """Whether its answer is a stream that lasts as long as somebody listens."""
        return self.scope["method"] == "GET" and _EVENTS.fullmatch(self.scope["path"]) is not None

    def deadline_s(self, default_s: float) -> float:
        """Seconds until its sender has no more use for an answer."""
        asked = _fields(self.body).get("deadline_ms") if self.scope["path"] in _BY_BODY else None
        return asked / 1e3 if isinstance(asked, int | float) and 0 < asked <= _LONGEST_MS else default_s


async def answer_of(app: ASGIApp, request: Exchanged) -> Answer:
    """What an ASGI application answers."""
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
