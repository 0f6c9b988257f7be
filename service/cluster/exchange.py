"""Requests and answers between the ingress and the owners of missions, and the routing of requests."""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain, zip_longest
from typing import Any

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope

from service.api.problem_details import CONTENT_TYPE, problem_response
from shared.wire.missions import MissionLine, MissionList
from shared.wire.schemas import Readiness

# The header with the time of an edge's newest decision.
DECIDED_AT = "x-decided-at"
_MOST_LISTED = 200
# Routes whose body names the mission, `default` unless it says otherwise.
_BY_BODY = frozenset(("/decide", "/decide/batch", "/feedback"))
_DEFAULT = "default"
_EVENTS = re.compile(r"/missions/[^/]+/events")
# The longest deadline of a request.
_LONGEST_MS = 60_000
# The entries of an ASGI scope that an application reads, apart from its own.
_SENT = ("type", "http_version", "method", "scheme", "path", "raw_path", "query_string", "root_path", "headers")


class OwnersGone(Exception):
    """The responsible edge has died, or does not answer in time."""


@dataclass
class Answer:
    """A buffered answer."""

    status: int = 0
    headers: list[tuple[bytes, bytes]] = field(default_factory=list)
    body: bytes = b""

    async def send(self, message: Message) -> None:
        """Take a message of the application."""
        if message["type"] == "http.response.start":
            self.status, self.headers = message["status"], list(message.get("headers", ()))
        else:
            self.body += message.get("body", b"")

    def header(self, name: str) -> str | None:
        """The value of a header in lower case."""
        return next((value.decode("latin-1") for key, value in self.headers if key.lower() == name.encode()), None)


def merged_metrics(answers: Mapping[str, Answer]) -> Response:
    """All samples of answers with status 200, at least one, each with the name of its edge as a label."""
    texts = {name: answer.body.decode() for name, answer in answers.items()}
    return Response(gathered(texts), media_type=next(iter(answers.values())).header("content-type"))


def merged_readiness(answers: Iterable[Answer]) -> Response:
    """Ready if all edges are; the LLM is ready if all have reached it."""
    found = [Readiness.model_validate_json(a.body) for a in answers if a.header("content-type") != CONTENT_TYPE]
    if not found:
        return problem_response(503, "no edge says whether it is ready: send the request again")
    shown = min(found, key=lambda one: (one.ready, one.llm == "ready"))
    return Response(shown.model_dump_json(), 200 if shown.ready else 503, media_type="application/json")


def merged_missions(answers: Iterable[Answer]) -> Response:
    """All edges' missions, interleaved, from the edge that decided last on; each edge's stay in their order.

    A mission that is only in the store may be in several lists. All answers have status 200; there is at least one.
    """
    listed = sorted(answers, key=lambda answer: -float(answer.header(DECIDED_AT) or 0.0))
    lists = [MissionList.model_validate_json(answer.body) for answer in listed]
    lines = dict[str, MissionLine]()
    for line in chain.from_iterable(zip_longest(*(one.missions for one in lists))):
        if line is not None and (line.mission_id not in lines or line.mode is not None):
            lines[line.mission_id] = line
    more = sum(one.more for one in lists) + max(0, len(lines) - _MOST_LISTED)
    newest = next((one.newest for one in lists if one.newest is not None), None)
    may_command = lists[0].may_command
    shown = list(lines.values())[:_MOST_LISTED]
    merged = MissionList(missions=shown, more=more, newest=newest, may_command=may_command)
    return Response(merged.model_dump_json(), media_type="application/json")


def gathered(texts: Mapping[str, str]) -> str:
    """Merge several processes' expositions in Prometheus's text format.

    The samples of a metric follow each other after one HELP and one TYPE, as the format demands. An absent process has
    no samples: the sum of rates over the others stays right, and its counters restart with it.
    """
    heads, samples = dict[str, list[str]](), dict[str, list[str]]()
    for process, text in texts.items():
        name = ""
        for line in text.splitlines():
            if line.startswith("# HELP "):
                name = line.split(" ", 3)[2]
                heads.setdefault(name, [])
            if not line.startswith("#"):
                samples.setdefault(name, []).append(_labelled(line, process))
            elif line not in heads.setdefault(name, []) and len(heads[name]) < 2:
                heads[name].append(line)
    ends = "# EOF\n" if any(text.endswith("# EOF\n") for text in texts.values()) else ""
    return "".join(f"{line}\n" for name in heads for line in (*heads[name], *samples.get(name, ()))) + ends


def _labelled(sample: str, process: str) -> str:
    """A sample with the label ``process``; no metric's name has a brace or a space."""
    name, brace, rest = sample.partition("{")
    if brace and " " not in name:
        return f'{name}{{process="{process}",{rest}'
    name, _, value = sample.partition(" ")
    return f'{name}{{process="{process}"}} {value}'


@dataclass(frozen=True, slots=True)
class Exchanged:
    """A whole HTTP request: the ASGI scope's plain entries, and the decoded body."""

    scope: dict[str, Any]
    body: bytes

    @classmethod
    async def read(cls, scope: Scope, receive: Receive) -> "Exchanged":
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
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _named_in(body: bytes) -> str | None:
    named = _fields(body).get("mission_id", _DEFAULT)
    return named if isinstance(named, str) else None
