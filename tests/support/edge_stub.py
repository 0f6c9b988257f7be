"""A stub edge that answers at once, or misbehaves by a script; a real server on a real port."""

from __future__ import annotations

import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from shared.planning.guidance_messages import GuidanceAnswer, GuidanceStatus
from shared.wire.missions import MissionStatus
from shared.wire.problem import Problem
from shared.wire.schemas import (
    Candidate,
    DecideRequest,
    DecideResponse,
    FeedbackRequest,
    FeedbackResponse,
    MissionSpec,
    Readiness,
    Tokens,
)
from shared.world.scenario import Scenario, scenario_named
from tests.support.running import serving
from tests.support.waiting import Gate

Behaviour = Literal[
    "ok", "busy", "busy_retry_after", "garbage", "invalid", "crash", "html", "slow", "forgot", "wrong", "elsewhere"
]
LLM = Literal["loading", "ready", "unavailable", "off"]


@dataclass
class EdgeStub:
    """``script`` has the behaviour for each of the next requests to /decide; the behaviour is ``otherwise`` after them.

    A request with the behaviour ``slow`` waits at the ``gate``; one with ``elsewhere`` gets the ``owner``'s address.
    ``decides``, ``feedbacks`` and ``missions`` have the valid requests.
    """

    url: str = ""
    script: list[Behaviour] = field(default_factory=list)
    otherwise: Behaviour = "ok"
    readiness: list[tuple[bool, LLM]] = field(default_factory=lambda: [(True, "ready")])
    model: str = "stub-1"
    velocity: int = 7
    owner: str | None = None
    gate: Gate = field(default_factory=Gate)
    request_count: int = 0
    polled: int = 0
    at_once: int = 0
    most_at_once: int = 0
    headers: list[dict[str, str]] = field(default_factory=list)
    decides: list[DecideRequest] = field(default_factory=list)
    feedbacks: list[FeedbackRequest] = field(default_factory=list)
    missions: dict[str, MissionSpec] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    flown: dict[str, int] = field(default_factory=dict)

    async def decide(self, request: Request) -> Response:
        """POST /decide."""
        self.request_count += 1
        self.headers.append(dict(request.headers))
        behaviour = self.script.pop(0) if self.script else self.otherwise
        body = DecideRequest.model_validate_json(await request.body())
        self.decides.append(body)
        if behaviour == "slow":
            self.at_once += 1
            self.most_at_once = max(self.most_at_once, self.at_once)
            await self.gate.passed()
            self.at_once -= 1
        refusal = self._elsewhere() if behaviour == "elsewhere" else _misbehave(behaviour, body)
        return refusal or Response(self._answer(body, behaviour).model_dump_json())

    def _elsewhere(self) -> Response:
        body = Problem(title="no", status=421, detail="another edge has it", owner=self.owner)
        return Response(body.model_dump_json(), 421, {"Retry-After": "3"}, media_type="application/problem+json")

    def _answer(self, body: DecideRequest, behaviour: Behaviour) -> DecideResponse:
        sensors = body.sensors.id
        sensor = 1_999 if behaviour == "wrong" else sensors[(body.step + body.uav_id) % len(sensors)]
        tokens = Tokens(
            tokenizer="stub",
            static=200,
            experiences=10 * body.step,
            state=40,
            state_uncompressed=90,
            prompt=240 + 10 * body.step,
            uncompressed=290 + 10 * body.step,
            saved=50,
            cached=200,
            server_prompt=250,
        )
        return DecideResponse(
            decision_id=uuid.uuid4().hex,
            mission_id=body.mission_id,
            uav_id=body.uav_id,
            step=body.step,
            sensor_id=sensor,
            velocity=self.velocity,
            source="llm" if body.step else "policy",
            reason=None if body.step else "llm_timeout",
            model=self.model,
            top_k=[Candidate(sensor_id=j, score=-float(j)) for j in sensors[:5]],
            tokens=tokens,
            deadline_ms=body.deadline_ms or 3000,
            latency_ms={"llm": 1.0, "total": 2.0},
        )

    async def feedback(self, request: Request) -> Response:
        """POST /feedback."""
        outcome = FeedbackRequest.model_validate_json(await request.body())
        if not self.script and self.otherwise == "crash":
            return Response(status_code=500)
        self.feedbacks.append(outcome)
        return Response(FeedbackResponse(decision_id=outcome.decision_id, result="applied").model_dump_json())

    async def put_mission(self, request: Request) -> Response:
        """PUT /missions/{mission_id}."""
        mission_id = request.path_params["mission_id"]
        self.missions[mission_id] = MissionSpec.model_validate_json(await request.body())
        return Response(self._status(mission_id).model_dump_json())

    async def mission(self, request: Request) -> Response:
        """GET and DELETE /missions/{mission_id}."""
        mission_id = request.path_params["mission_id"]
        if mission_id not in self.missions:
            return _problem(404, "mission_id: unknown")
        if request.method == "DELETE":
            del self.missions[mission_id]
            return Response(status_code=204)
        return Response(self._status(mission_id).model_dump_json())

    async def guide(self, request: Request) -> Response:
        """POST /missions/{mission_id}/guidance with a new note."""
        mission_id = request.path_params["mission_id"]
        answer = GuidanceAnswer.model_validate_json(await request.body())
        self.notes[mission_id] = answer.note or ""
        return Response(GuidanceStatus(mission_id=mission_id, status="compiling", note=answer.note).model_dump_json())

    def _status(self, mission_id: str) -> MissionStatus:
        spec = self.missions[mission_id]
        world = spec.scenario if isinstance(spec.scenario, Scenario) else scenario_named(spec.scenario)
        counts: dict[str, Any] = dict.fromkeys(("decisions", "feedback", "experiences", "learner_updates"), 0)
        counts["decisions"] = self.flown.get(mission_id, 0)
        return MissionStatus(
            mission_id=mission_id,
            scenario=world,
            mode=spec.mode or "llm",
            top_k=5,
            init=spec.init,
            seed=spec.seed,
            note=self.notes.get(mission_id, spec.note),
            learner_loss=None,
            visits={},
            **counts,
        )

    async def readyz(self, request: Request) -> Response:
        """GET /readyz."""
        self.polled += 1
        ready, llm = self.readiness.pop(0) if len(self.readiness) > 1 else self.readiness[0]
        decides: Literal["llm", "policy"] = "llm" if llm == "ready" else "policy"
        return Response(Readiness(ready=ready, decides=decides, llm=llm, model=self.model).model_dump_json())

    def app(self) -> Starlette:
        """The ASGI application."""
        return Starlette(
            routes=[
                Route("/decide", self.decide, methods=["POST"]),
                Route("/feedback", self.feedback, methods=["POST"]),
                Route("/missions/{mission_id}", self.put_mission, methods=["PUT"]),
                Route("/missions/{mission_id}", self.mission, methods=["GET", "DELETE"]),
                Route("/missions/{mission_id}/guidance", self.guide, methods=["POST"]),
                Route("/readyz", self.readyz, methods=["GET"]),
            ]
        )


def _misbehave(behaviour: Behaviour, body: DecideRequest) -> Response | None:
    match behaviour:
        case "busy":
            return _problem(503, "overloaded")
        case "busy_retry_after":
            return _problem(503, "overloaded", {"Retry-After": "0.2"})
        case "garbage":
            return Response("42 7, roughly")
        case "invalid":
            errors = [{"field": "sensors.queue[0]", "problem": "must be less than 100000"}]
            return _problem(422, "sensors.queue[0]: too many", errors=errors)
        case "crash":
            return _problem(500, "the edge failed; its log has the details")
        case "html":
            return Response("<h1>Bad gateway</h1>\nnginx", status_code=404)
        case "forgot" if body.outcome is not None:
            errors = [{"field": "outcome.decision_id", "problem": "unknown"}]
            return _problem(404, "outcome.decision_id: unknown", errors=errors)
    return None


def _problem(
    status: int, detail: str, headers: dict[str, str] | None = None, errors: list[dict[str, str]] | None = None
) -> Response:
    body = Problem(title="no", status=status, detail=detail, errors=errors or [])
    return Response(body.model_dump_json(), status, headers, media_type="application/problem+json")


@contextmanager
def stub_edge() -> Iterator[EdgeStub]:
    """A stub on a free port."""
    stub = EdgeStub()
    with serving(stub.app()) as url, stub.gate:
        stub.url = url
        yield stub


def free_port() -> int:
    """A free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def stub_edge_at(port: int) -> Iterator[EdgeStub]:
    """A new stub without missions on a given port, such as that of an earlier stub."""
    stub = EdgeStub(url=f"http://127.0.0.1:{port}")
    with serving(stub.app(), port):
        yield stub
