"""Missions shared out over several LLM servers: each has its own, and the next where that is gone or full."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import httpx
import pytest
from fastapi import Request
from fastapi.responses import Response
from pydantic import ValidationError

from service.config.settings import Settings
from service.llm.answers import NoDecision
from service.llm.request_bodies import WarmUp
from service.llm.server import ServerStatus
from service.llm.server_pool import ServerPool
from tests.integration.service.llm.test_server_pool import Named, standing_by
from tests.support.running import serving
from tests.support.stub_llm import StubLlm, wait_for
from tests.support.waiting import Gate, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

URLS = [f"http://{host}/v1" for host in "abcd"]
MISSIONS = [f"mission-{number}" for number in range(200)]


def pool(urls: list[str], order: str = "mission") -> ServerPool:
    """Servers that are ready."""
    settings = Settings.model_validate({"llm_url": ",".join(urls), "llm_order": order})
    servers = ServerPool(settings, WarmUp("", "", None))
    for server in servers._each:
        server.status = ServerStatus("ready")
    return servers


def test_every_edge_sends_a_mission_to_the_same_server() -> None:
    one, other = pool(URLS), pool(URLS[::-1])
    placed = [one.serving(mission).url for mission in MISSIONS]
    assert placed == [other.serving(mission).url for mission in MISSIONS]
    assert set(placed) == set(URLS)


def test_only_the_missions_of_a_server_that_fails_move_and_they_return() -> None:
    servers = pool(URLS)
    before = {mission: servers.serving(mission) for mission in MISSIONS}
    gone = servers._each[1]
    gone.status = ServerStatus("unavailable")
    after = {mission: servers.serving(mission) for mission in MISSIONS}
    moved = {mission for mission in MISSIONS if after[mission] is not before[mission]}
    assert moved == {mission for mission in MISSIONS if before[mission] is gone}
    assert {after[mission] for mission in moved} == set(servers._each) - {gone}
    gone.status = ServerStatus("ready")
    assert {mission: servers.serving(mission) for mission in MISSIONS} == before


def test_by_preference_every_mission_has_the_first() -> None:
    assert {pool(URLS, "preference").serving(mission).url for mission in MISSIONS} == {URLS[0]}


def test_missions_are_asked_of_their_own_servers(edge: Edge, report: Report) -> None:
    with serving(Named("first", "0 7").app) as first, serving(Named("second", "1 7").app) as second:
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", llm_order="mission")
        standing_by(client, 1)
        models: dict[str, set[str]] = {}
        for step in range(2):
            for mission in MISSIONS[:12]:
                answer = client.post("/decide", json=report(mission_id=mission, step=step)).json()
                assert answer["source"] == "llm"
                models.setdefault(mission, set()).add(answer["model"])
        assert all(len(asked) == 1 for asked in models.values())
        assert set.union(*models.values()) == {"first", "second"}


@pytest.mark.parametrize("order", ["preference", "mission"])
def test_a_full_server_leaves_the_rest_to_the_next(edge: Edge, report: Report, order: str) -> None:
    asked: list[str] = []

    class Waiting(Named):
        async def deciding(self) -> None:
            await answering.passed()

    def decide() -> None:
        step, uav = divmod(len(asked), 3)
        client.post("/decide", json=report(mission_id="full", uav_id=uav, step=step)).raise_for_status()

    with ExitStack() as stack:
        urls = [stack.enter_context(serving(Waiting(name, "0 7", asked).app)) + "/v1" for name in ("first", "second")]
        answering = stack.enter_context(Gate())
        requests = stack.enter_context(ThreadPoolExecutor(3))
        client = edge(mode="llm", llm_url=",".join(urls), llm_order=order, llm_slots=1)
        standing_by(client, 1)
        answers = []
        for count in (1, 2, 3):
            answers.append(requests.submit(decide))
            until(lambda count=count: len(asked) == count)  # type: ignore[misc]
        # Both are full: the third waits at the mission's own.
        assert asked[0] != asked[1] and asked[2] == asked[0]
        answering.open()
        for answer in answers:
            answer.result()
        # Both are free again.
        decide()
        assert asked[3] == asked[0]


class Listening(StubLlm):
    """Keeps the header of each request."""

    def __init__(self) -> None:
        super().__init__()
        self.sessions: list[str | None] = []

    async def complete(self, request: Request) -> Response:
        self.sessions.append(request.headers.get("x-user-id"))
        return await super().complete(request)


@pytest.mark.parametrize("header", ["x-user-id", None])
def test_a_header_names_the_mission_to_a_router(edge: Edge, report: Report, header: str | None) -> None:
    router = Listening()
    with serving(router.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_session_header=header)
        wait_for(client, "ready")
        router.sessions.clear()
        client.post("/decide", json=report(mission_id="north"))
        client.post("/decide", json=report(mission_id="south"))
    assert router.sessions == (["north", "south"] if header else [None, None])


@pytest.mark.parametrize("name", ["x user", "x:user", "x\r\nuser", ""])
def test_a_header_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(ValidationError):
        Settings(llm_session_header=name)


async def test_answers_that_come_too_late_do_not_degrade_a_server_and_unusable_ones_do() -> None:
    servers = pool(URLS[:1])
    for _ in range(6):
        servers.record_usability("test", NoDecision("llm_timeout", "late"))
    assert servers.statuses == {"ready": 1}
    for _ in range(5):
        servers.record_usability("test", NoDecision("answer_format", "cheese"))
    assert servers.statuses == {"degraded": 1}
    servers.record_usability("test", None)
    assert servers.statuses == {"ready": 1}
    await servers.close()
