"""LLM servers that refuse by unusual statuses, lose connections, are busy as they are probed, or get another model."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response
from pydantic import ValidationError

from service.config.settings import Settings
from service.llm.answers import NoDecision
from service.llm.client import LLMClient
from tests.integration.service.llm.test_server import Model
from tests.integration.service.llm.test_server_pool import Named, standing_by
from tests.integration.service.llm.test_servers_as_seen import Behaviour, Body, Plain, refused
from tests.support.running import listening, serving
from tests.support.stub_llm import FIRST, StubLlm, chat_completion, wait_for
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def has_a_template_that_raises(body: Body) -> Response | str:
    """The words of llama.cpp's templates that raise, by a status that says nothing of the request."""
    if body["messages"][0]["role"] == "system":
        return refused("Jinja Exception: System role not supported", status=500)
    return "0 7"


def forbids_a_field(body: Body) -> Response | str:
    """Own: a gateway that checks fields before it asks its model."""
    if "max_tokens" in body:
        return refused("max_tokens is not allowed: use max_completion_tokens", "max_tokens", 403)
    return "0 7"


def begins_its_message_with_a_capital(body: Body) -> Response | str:
    """Own."""
    return refused("Temperature must be greater than 0.") if "temperature" in body else "0 7"


def thinks_on_without_a_tag(body: Body) -> Response | str:
    """DeepSeek-R1's template opens the thoughts in the prompt, and no parser of the server takes them out."""
    if body["max_tokens"] < 200:
        message = {"role": "assistant", "content": "Okay, so I need to pick a sensor. The first one"}
        return JSONResponse({"choices": [{"message": message, "finish_reason": "length"}]})
    return "Okay, so I need to pick a sensor. The first one is nearly full.\n</think>\n\n0 7"


@pytest.mark.parametrize(
    "behaviour",
    [has_a_template_that_raises, forbids_a_field, begins_its_message_with_a_capital, thinks_on_without_a_tag],
    ids=lambda behaviour: behaviour.__name__,
)
def test_the_llm_decides_with_a_server_that(behaviour: Behaviour, edge: Edge, report: Report) -> None:
    with serving(Plain(behaviour).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        answers = [client.post("/decide", json=report(step=step)).json() for step in range(3)]
    assert [(a["source"], a["sensor_id"], a["velocity"]) for a in answers] == [("llm", 0, 7)] * 3


async def test_any_number_of_idle_connections_may_have_been_closed() -> None:
    """Each connection answers one request and is closed without an answer at the second (aiohttp 9138)."""
    came = 0
    all_here = asyncio.Event()

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal came
        for answers in (True, False):
            head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
            await reader.readexactly(int(head.split("content-length:")[1].split("\r\n")[0]))
            if not answers:
                writer.transport.abort()
                return
            came += 1
            if came == 3:
                all_here.set()
            await all_here.wait()
            answer = json.dumps({"choices": [{"message": {"content": "0 7"}}]}).encode()
            writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(answer), answer))
            await writer.drain()

    body = {"messages": [], "max_tokens": 9, "stream": False}
    server = await asyncio.start_server(handler, "127.0.0.1", 0)
    client = LLMClient(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1", trust_env=False)
    try:
        # Three at once, so that three connections are kept.
        await asyncio.gather(*(client.complete(body) for _ in range(3)))
        assert (await client.complete(body)).text == "0 7"
        assert came == 4
    finally:
        await client.close()
        server.close()


def test_a_model_renamed_while_the_server_failed_is_asked_for_again(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway answers 502 while it swaps its model."""
    monkeypatch.setattr("service.llm.usability.PAUSE_S", 0.05)
    name = "old"
    swapping = False

    def knows_one_model(body: Body) -> Response | str:
        if swapping:
            return JSONResponse({"error": "bad gateway"}, 502)
        known = body.get("model") == name
        return "0 7" if known else refused(f"The model '{body.get('model')}' does not exist", "model", 404)

    server = Plain(knows_one_model)
    app = FastAPI()
    app.get("/v1/models")(lambda: {"data": [{"id": name}]})
    app.post("/v1/chat/completions")(server.complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["model"] == "old"
        swapping = True
        for step in range(3):
            client.post("/decide", json=report(step=step))
        assert client.get("/readyz").json()["llm"] == "unavailable"
        name, swapping = "new", False
        until(lambda: client.get("/readyz").json()["model"] == "new")
        wait_for(client, "ready")
        assert client.post("/decide", json=report(step=5)).json()["source"] == "llm"


def test_a_server_whose_engine_dies_and_that_then_ends_is_probed_anew_after_its_restart(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As seen of vLLM 0.32: its worker was killed, it answered 500 to each request, and its process ended."""
    monkeypatch.setattr("service.llm.usability.PAUSE_S", 0.05)
    monkeypatch.setattr("service.llm.usability.LONGEST_PAUSE_S", 3600.0)
    monkeypatch.setattr("service.llm.server.RETRY_S", 0.05)
    server, dead = Model("structured_outputs"), False

    async def complete(request: Request) -> Response:
        return (
            JSONResponse({"error": "EngineCore encountered an issue."}, 500) if dead else await server.complete(request)
        )

    app = FastAPI()
    app.post("/v1/chat/completions")(complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["constraint"] == "structured_outputs"
        dead = True
        for step in range(3):
            client.post("/decide", json=report(step=step))
        # The reason is the newest one, of the probes too.
        until(lambda: "still fails" in client.get("/readyz").json()["detail"])
    until(lambda: "Connect" in client.get("/readyz").json()["detail"])
    with serving(Model("grammar").app, port=int(url.rsplit(":", 1)[1])):
        assert wait_for(client, "ready")["constraint"] == "grammar"
        assert client.post("/decide", json=report(step=5)).json()["source"] == "llm"


def test_a_server_that_is_busy_as_it_is_probed_keeps_its_grammar(edge: Edge) -> None:
    class Busy(StubLlm):
        asked = 0

        async def respond(self, body: Body, probed: bool) -> Response:
            self.asked += 1
            if self.asked == 1:
                return JSONResponse({"error": "busy"}, 429, {"Retry-After": "0.1"})
            return chat_completion("7301 0") if "grammar" in body else chat_completion("Hello.")

    with serving(Busy().app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["constraint"] == "grammar"


def test_a_server_that_asks_for_a_long_pause_is_not_asked_before(edge: Edge) -> None:
    asked = []

    def has_no_quota(body: Body) -> Response | str:
        asked.append(body)
        return JSONResponse({"error": {"message": "quota"}}, 429, {"Retry-After": "60"})

    with serving(Plain(has_no_quota).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        assert "quota (no requests for 60 s)" in wait_for(client, "unavailable")["detail"]
        assert len(asked) == 1


def test_unusable_answers_count_against_the_server_that_gave_them_whatever_its_model(
    edge: Edge, report: Report
) -> None:
    """Two servers of one model: the first is asked first and is well; the second answers no pair of numbers."""

    class Failing(Named):
        async def respond(self, body: Body, probed: bool) -> Response:
            if not probed and body["messages"][-1]["content"] != FIRST:
                return JSONResponse({"error": "no slot"}, 429, {"Retry-After": "0.1"})
            return await super().respond(body, probed)

    with serving(Failing("same", "0 7").app) as first, serving(Named("same", "cheese").app) as second:
        client = edge(mode="llm", llm_url=f"{first}/v1,{second}/v1", deadline_ms=300)
        standing_by(client, 1)
        reasons = [client.post("/decide", json=report(step=step)).json()["reason"] for step in range(8)]
        assert "answer_format" in reasons
        ready = client.get("/readyz").json()
        assert ready["llm"] == "ready", ready


@pytest.mark.parametrize("url", ["http://a/v1?api-version=1", "http://a:70000/v1", "http://a:0/v1", "http://a/v1#x"])
def test_an_address_of_another_form_is_refused(url: str) -> None:
    with pytest.raises(ValidationError, match="llm_url"):
        Settings(llm_url=url)


async def test_certificates_that_cannot_be_read_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for file, content in (("missing.pem", None), ("empty.pem", "no certificate")):
        if content is not None:
            (tmp_path / file).write_text(content)
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / file))
        with pytest.raises(NoDecision, match="SSL_CERT_FILE"):
            LLMClient("https://llm.example/v1")


async def test_a_server_that_closes_every_connection_is_a_failure() -> None:
    """A server that closes each connection at once, kept or new, ends in a failure, not in a loop."""

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.transport.abort()

    with listening(handler) as url:
        client = LLMClient(f"{url}/v1", trust_env=False)
        with pytest.raises(NoDecision):
            await client.complete({"messages": [], "max_tokens": 9, "stream": False})
        await client.close()
