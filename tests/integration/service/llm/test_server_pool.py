"""Several LLM servers: the first that is well is asked, the next where it fails, and a second beside a slow one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi.responses import Response
from pydantic import ValidationError

from service.config.settings import Settings
from tests.support.running import listening, serving
from tests.support.stub_llm import FIRST, StubLlm, http_answer, misbehaving, silent, wait_for
from tests.support.waiting import Gate, Striding, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


class Named(StubLlm):
    """A server with a model of its own; ``asked`` tells whose turn it was at each decision, of all that share it."""

    def __init__(self, name: str, answer: str, asked: list[str] | None = None) -> None:
        super().__init__(answer)
        self.name = name
        self.asked = [] if asked is None else asked

    async def models(self) -> dict[str, Any]:
        return {"data": [{"id": self.name}]}

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        if not probed and body["messages"][-1]["content"] != FIRST:
            self.asked.append(self.name)
            await self.deciding()
        return await super().respond(body, probed)

    async def deciding(self) -> None:
        """What comes between a question and its answer."""


def standing_by(client: httpx.Client, count: int) -> dict[str, Any]:
    ready: dict[str, Any] = {}

    def there() -> bool:
        ready.update(client.get("/readyz").json())
        return bool(ready["standing_by"] == count)

    until(there, lambda: ready)
    return ready


def test_the_first_that_is_well_decides_and_the_next_where_it_is_gone(edge: Edge, report: Report) -> None:
    with serving(Named("second", "1 7").app) as second:
        with serving(Named("first", "0 7").app) as first:
            client = edge(mode="llm", llm_url=f"{first}/v1, {second}/v1")
            wait_for(client, "ready")
            standing_by(client, 1)
            answer = client.post("/decide", json=report()).json()
            assert (answer["sensor_id"], answer["model"]) == (0, "first")
        # Gone, and nobody knows yet: this very decision is the second's.
        answer = client.post("/decide", json=report(step=1)).json()
        assert (answer["sensor_id"], answer["model"], answer["source"]) == (1, "second", "llm")
        assert client.get("/readyz").json()["model"] == "second"
        standing_by(client, 0)


@pytest.mark.usefixtures("left_alone")
def test_a_server_that_answers_with_errors_costs_nobody_a_decision(edge: Edge, report: Report) -> None:
    with (
        listening(misbehaving(http_answer(b"500 Oops", b"oops"))) as first,
        serving(Named("second", "1 7").app) as second,
    ):
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", llm_model="first,second")
        standing_by(client, 1)
        answers = [client.post("/decide", json=report(step=step)).json() for step in range(5)]
        assert {(answer["source"], answer["model"]) for answer in answers} == {("llm", "second")}
        # Its own breaker opened.
        assert "aicvds_llm_breaker_opened_total 1.0" in client.get("/metrics").text


def test_a_second_is_asked_beside_one_that_is_silent(edge: Edge, report: Report) -> None:
    asked: list[str] = []

    async def hangs(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append("first")
        await silent(reader, writer)

    with listening(misbehaving(hangs)) as first, serving(Named("second", "1 7", asked).app) as second:
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", hedge_ms=200)
        standing_by(client, 1)
        answer = client.post("/decide", json=report()).json()
        assert (answer["source"], answer["model"]) == ("llm", "second")
        assert asked == ["first", "second"]


def test_the_only_server_is_asked_again_beside_itself(edge: Edge, report: Report) -> None:
    asked_again = asyncio.Event()

    class Stuck(StubLlm):
        asked = 0

        async def respond(self, body: dict[str, Any], probed: bool) -> Response:
            self.asked += not probed and body["messages"][-1]["content"] != FIRST
            if self.asked == 1:
                await asked_again.wait()
            elif self.asked == 2:
                asked_again.set()
            return await super().respond(body, probed)

    stuck = Stuck("1 7")
    with serving(stuck.app) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1", hedge_ms=50)
        wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["source"] == "llm"
        assert stuck.asked == 2


def test_where_all_fail_the_first_ones_fault_is_told(edge: Edge, report: Report) -> None:
    bad, worse = http_answer(b"429 Too Many Requests", b"{}"), http_answer(b"200 OK", b"<html>")
    with listening(misbehaving(bad)) as first, listening(misbehaving(worse)) as second:
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1")
        standing_by(client, 1)
        assert client.post("/decide", json=report()).json()["reason"] == "llm_status"


@pytest.mark.parametrize(
    "given",
    [
        {"llm_url": "http://a/v1,ftp://b/v1"},
        {"llm_url": "http://a/v1,"},
        {"llm_url": "http://a/v1,http://b/v1", "llm_model": "x,y,z"},
        {"llm_url": "http://a/v1,http://b/v1", "llm_api_key": "hunter2,hunter3,hunter4"},
    ],
)
def test_lists_that_do_not_fit_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValidationError) as refused:
        Settings(**given)
    assert "hunter" not in "".join(error["msg"] for error in refused.value.errors())


def test_each_server_gets_its_own_key_or_all_the_same() -> None:
    urls = "http://a/v1,http://b/v1/"
    each = Settings(llm_url=urls, llm_api_key="one,two").each_server()
    reported = [(s.llm_url, s.llm_api_key and s.llm_api_key.get_secret_value(), s.llm_model) for s in each]
    assert reported == [("http://a/v1", "one", None), ("http://b/v1", "two", None)]
    each = Settings(llm_url=urls, llm_api_key="one", llm_model="m,").each_server()
    assert [s.llm_model for s in each] == ["m", None]
    assert {s.llm_api_key and s.llm_api_key.get_secret_value() for s in each} == {"one"}


def test_who_was_asked_later_and_answered_later_is_no_failure(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow(Named):
        async def deciding(self) -> None:
            # Its answer waits until the other server is asked too, in whichever order the two requests arrive.
            while self.asked.count("second") < self.asked.count("first"):
                await asyncio.sleep(0.002)

    class Slower(Named):
        async def deciding(self) -> None:
            await never.passed()

    asked: list[str] = []
    # By this clock, a server whose call is cancelled had longer than any deadline.
    monkeypatch.setattr("service.llm.server.time", Striding(100.0))
    with (
        serving(Slow("first", "0 7", asked).app) as first,
        serving(Slower("second", "1 7", asked).app) as second,
        Gate() as never,
    ):
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", hedge_ms=20)
        standing_by(client, 1)
        for step in range(12):
            assert client.post("/decide", json=report(step=step)).json()["model"] == "first"
        assert (asked.count("first"), asked.count("second")) == (12, 12)
        assert client.get("/readyz").json()["standing_by"] == 1
        assert "aicvds_llm_breaker_opened_total 0.0" in client.get("/metrics").text


def test_unusable_answers_count_against_the_server_that_gave_them(edge: Edge, report: Report) -> None:
    """The first server is well but slow, and the second is asked beside it and answers no pair of numbers."""
    asked: list[str] = []

    class Late(Named):
        async def deciding(self) -> None:
            await never.passed()

    with (
        serving(Late("first", "0 7", asked).app) as first,
        serving(Named("second", "cheese", asked).app) as second,
        Gate() as never,
    ):
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", hedge_ms=20)
        standing_by(client, 1)
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(8)]
        assert "answer_format" in reasons
        ready = client.get("/readyz").json()
        assert ready["model"] == "first" and ready["llm"] == "ready", ready


def test_a_refused_request_counts_against_the_server_that_refuses_it(edge: Edge, report: Report) -> None:
    """The first server asks for a pause, and the second, asked in its place, understands no request."""

    class Refusing(Named):
        def __init__(self, name: str, status: int, **headers: str) -> None:
            super().__init__(name, "0 7")
            self.status, self.headers = status, headers

        async def respond(self, body: dict[str, Any], probed: bool) -> Response:
            if probed or body["messages"][-1]["content"] == FIRST:
                return await super().respond(body, probed)
            return Response(b"{}", self.status, self.headers)

    with (
        serving(Refusing("first", 429, **{"retry-after": "300"}).app) as first,
        serving(Refusing("second", 400).app) as second,
    ):
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1")
        standing_by(client, 1)
        reasons = {client.post("/decide", json=report(step=step)).json()["reason"] for step in range(6)}
        assert reasons == {"llm_status"}
        ready = client.get("/readyz").json()
        assert ready["model"] == "first" and ready["llm"] == "ready", ready


@pytest.mark.usefixtures("left_alone")
def test_a_server_that_is_silent_again_and_again_is_left_out_though_another_answers_for_it(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    async def hangs(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append("first")
        await silent(reader, writer)

    # By this clock, a cancelled call had longer than any deadline.
    monkeypatch.setattr("service.llm.server.time", Striding(100.0))
    with listening(misbehaving(hangs)) as first, serving(Named("second", "1 7", asked).app) as second:
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", hedge_ms=200)
        standing_by(client, 1)
        for step in range(5):
            assert client.post("/decide", json=report(step=step)).json()["model"] == "second"
        assert "aicvds_llm_breaker_opened_total 1.0" in client.get("/metrics").text
    assert asked == ["first", "second"] * 3 + ["second"] * 2
