"""The wrapper of every answer: which refusals are logged, and what becomes of HEAD."""

from __future__ import annotations

import httpx
import pytest
from starlette.types import Receive, Scope, Send

from service.server.middleware import SecurityHeaders
from tests.support.waiting import Clock

TRACED = {"traceparent": "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"}


async def refusing(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers by the status that the path names; its header has the method."""
    status = int(scope["path"].split("/")[1])
    headers = [(b"x-method", scope["method"].encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": b""})


@pytest.fixture
def clock(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The middleware's clock; its log is captured from INFO on."""
    clock = Clock()
    monkeypatch.setattr("service.server.middleware.time", clock)
    caplog.set_level("INFO")
    return clock


def client() -> httpx.AsyncClient:
    return httpx.AsyncClient(transport=httpx.ASGITransport(SecurityHeaders(refusing)), base_url="http://localhost")


def logged(caplog: pytest.LogCaptureFixture) -> list[int]:
    return [record.__dict__["status"] for record in caplog.records if record.name == "service.server.middleware"]


async def test_of_one_status_the_first_refusal_of_a_minute_is_logged_and_each_that_has_a_trace(
    caplog: pytest.LogCaptureFixture, clock: Clock
) -> None:
    async with client() as http:
        for path, headers in (
            ("/404", {}),
            ("/404", {}),
            ("/200", {}),
            ("/422", {}),
            ("/404", TRACED),
            ("/404", TRACED),
        ):
            await http.get(path, headers=headers)
        assert logged(caplog) == [404, 422, 404, 404]
        clock.ahead_s = 61.0
        await http.get("/404")
    assert logged(caplog) == [404, 422, 404, 404, 404]


async def test_of_a_minute_no_more_than_sixty_refusals_are_logged(
    caplog: pytest.LogCaptureFixture, clock: Clock
) -> None:
    async with client() as http:
        for ahead_s in (0.0, 61.0):
            clock.ahead_s = ahead_s
            for _ in range(70):
                await http.get("/404", headers=TRACED)
    assert len(logged(caplog)) == 120


async def test_head_is_answered_as_get_except_for_a_stream() -> None:
    async with client() as http:
        assert (await http.head("/200/missions")).headers["x-method"] == "GET"
        assert (await http.head("/200/events")).headers["x-method"] == "HEAD"
