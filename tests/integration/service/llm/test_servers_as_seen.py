"""LLM servers that behave as real ones were seen or reported to: the LLM decides wherever a person could read it."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, RedirectResponse, Response

from tests.integration.service.llm.test_server_pool import standing_by
from tests.support.running import listening, serving
from tests.support.stub_llm import FIRST, StubLlm, chat_completion, wait_for
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]
Body = dict[str, Any]
Behaviour = Callable[[Body], Response | str]

KEY = "sk-live-51-do-not-print"


def refused(message: str, param: str | None = None, status: int = 400) -> Response:
    """OpenAI's error object."""
    error = {"message": message, "type": "invalid_request_error", "param": param, "code": "unsupported_value"}
    return JSONResponse({"error": error}, status)


class Plain(StubLlm):
    """Ignores unknown fields, as Ollama does, and answers ``0 7``, or what ``behaviour`` makes of a body."""

    def __init__(self, behaviour: Behaviour) -> None:
        super().__init__()
        self.behaviour = behaviour

    async def respond(self, body: Body, probed: bool) -> Response:
        answer = self.behaviour(body)
        return chat_completion(answer) if isinstance(answer, str) else answer


def wants_max_completion_tokens(body: Body) -> Response | str:
    if "max_tokens" in body:
        words = "Unsupported parameter: 'max_tokens' is not supported with this model. Use 'max_completion_tokens'."
        return refused(words, "max_tokens")
    return "0 7"


def wants_no_temperature(body: Body) -> Response | str:
    if "temperature" in body:
        words = "Unsupported value: 'temperature' does not support 0 with this model. Only the default (1) value is."
        return refused(words, "temperature")
    return "0 7"


def wants_both(body: Body) -> Response | str:
    first = wants_max_completion_tokens(body)
    return wants_no_temperature(body) if first == "0 7" else first


def forbids_temperature(body: Body) -> Response | str:
    detail = [{"type": "extra_forbidden", "loc": ["body", "temperature"], "msg": "Extra inputs are not permitted"}]
    return JSONResponse({"detail": detail}, 422) if "temperature" in body else "0 7"


def has_no_system_role(body: Body) -> Response | str:
    if body["messages"][0]["role"] == "system":
        return refused("System role not supported", status=400)
    # The instructions have become a part of the user's message.
    return "0 7" if len(body["messages"]) == 1 else "?"


def has_no_developer_instruction(body: Body) -> Response | str:
    if body["messages"][0]["role"] == "system":
        return JSONResponse([{"error": {"code": 400, "message": "Developer instruction is not enabled"}}], 400)
    return "0 7"


def thinks_aloud(body: Body) -> str:
    return "<think>\nSensor 0 has the longest queue, 3 7 would be worse.\n</think>\n\n0 7"


def thinks_nothing(body: Body) -> str:
    return "<think></think>0 7"


def closes_thoughts_that_the_template_opened(body: Body) -> str:
    return "Sensor 0, then.\n</think>\n\n0 7"


def thinks_for_200_tokens(body: Body) -> Response:
    if body["max_tokens"] < 200:
        message = {"content": "", "reasoning": "Let me see"}
        return JSONResponse({"choices": [{"message": message, "finish_reason": "length"}]})
    return JSONResponse({"choices": [{"message": {"content": "0 7", "reasoning": "..."}, "finish_reason": "stop"}]})


def thinks_in_tags_for_2000_tokens(body: Body) -> Response:
    if body["max_tokens"] < 2000:
        return chat_completion("<think>Let me see", finish_reason="length")
    return chat_completion("<think>Let me see.</think>0 7", finish_reason="stop")


def has_null_content_while_it_thinks(body: Body) -> Response:
    if body["max_tokens"] < 200:
        choice = {"message": {"content": None, "reasoning_content": "Hm"}, "finish_reason": "length"}
        return JSONResponse({"choices": [choice]})
    return chat_completion("0 7")


def answers_in_parts(body: Body) -> Response:
    parts = [{"type": "thinking", "thinking": []}, {"type": "text", "text": "0 "}, {"type": "text", "text": "7"}]
    return JSONResponse({"choices": [{"message": {"content": parts}}]})


def answers_in_a_fence(body: Body) -> str:
    return '```json\n{"sensor_id": 0, "velocity": 7}\n```'


def answers_with_a_further_key(body: Body) -> str:
    return '{"reason": "the longest queue", "sensor_id": 0, "velocity": 7}\n'


def accounts_oddly(body: Body) -> Response:
    return chat_completion("0 7", {"prompt_tokens": "12", "prompt_tokens_details": "none", "completion_tokens": -1})


def sends_usage_as_a_list(body: Body) -> Response:
    return JSONResponse({"choices": [{"message": {"content": " 0 7\n"}}], "usage": [1]})


def fails_at_what_is_optional(body: Body) -> Response | str:
    if {"grammar", "structured_outputs", "response_format", "logprobs", "post_sampling_probs"} & body.keys():
        return JSONResponse({"message": "internal error"}, 500)
    return "0 7"


SEEN: list[Behaviour] = [
    wants_max_completion_tokens,
    wants_no_temperature,
    wants_both,
    forbids_temperature,
    has_no_system_role,
    has_no_developer_instruction,
    thinks_aloud,
    thinks_nothing,
    closes_thoughts_that_the_template_opened,
    thinks_for_200_tokens,
    thinks_in_tags_for_2000_tokens,
    has_null_content_while_it_thinks,
    answers_in_parts,
    answers_in_a_fence,
    answers_with_a_further_key,
    accounts_oddly,
    sends_usage_as_a_list,
    fails_at_what_is_optional,
]


@pytest.mark.parametrize("behaviour", SEEN, ids=lambda behaviour: behaviour.__name__)
def test_the_llm_decides_with_a_server_that(behaviour: Behaviour, edge: Edge, report: Report) -> None:
    server = Plain(behaviour)
    with serving(server.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        before = len(server.bodies)
        answers = [client.post("/decide", json=report(step=step)).json() for step in range(3)]
    assert [(a["source"], a["sensor_id"], a["velocity"]) for a in answers] == [("llm", 0, 7)] * 3
    # The server's terms were learned as it was brought up.
    assert len(server.bodies) == before + 3


@pytest.mark.parametrize("listed", [None, [], ["stub-1"], [{"id": "stub-1"}], {"data": None}, {"data": []}])
def test_no_list_of_models_is_needed(edge: Edge, report: Report, listed: Any) -> None:
    server = Plain(lambda body: "0 7")
    app = FastAPI()
    if listed is not None:
        app.get("/v1/models")(lambda: JSONResponse(listed))
    app.post("/v1/chat/completions")(server.complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        ready = wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["source"] == "llm"
    assert ready["model"] == ("stub-1" if listed and "stub-1" in str(listed) else None)


def test_the_operators_fields_headers_and_query_are_sent(edge: Edge, report: Report) -> None:
    seen: list[tuple[str | None, str | None]] = []

    async def complete(request: Request) -> Response:
        seen.append((request.headers.get("api-key"), request.query_params.get("api-version")))
        body = await request.json()
        thinks = body.get("chat_template_kwargs", {}).get("enable_thinking", True)
        return chat_completion("<think>" if thinks else "0 7")

    app = FastAPI()
    app.post("/v1/chat/completions")(complete)
    with serving(app) as url:
        client = edge(
            mode="llm",
            llm_url=f"{url}/v1",
            llm_extra_body='{"chat_template_kwargs": {"enable_thinking": false}}',
            llm_extra_headers={"api-key": KEY},
            llm_extra_query='{"api-version": "preview"}',
        )
        wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["source"] == "llm"
    assert set(seen) == {(KEY, "preview")}


def test_a_server_of_no_use_is_named_with_its_own_words_and_the_next_one_decides(edge: Edge, report: Report) -> None:
    def refuses_real_prompts(body: Body) -> Response | str:
        asked = body["messages"][-1]["content"]
        filtered = f"The prompt of {KEY} violates our content policy"
        return "0 7" if asked in ("Say hello.", FIRST) else refused(filtered)

    with serving(Plain(refuses_real_prompts).app) as useless, serving(Plain(lambda body: "0 7").app) as spare:
        alone = edge(mode="llm", llm_url=f"{useless}/v1", llm_api_key=KEY)
        pair = edge(mode="llm", llm_url=f"{useless}/v1,{spare}/v1")
        for client in (alone, pair):
            wait_for(client, "ready")
        for step in range(5):
            alone.post("/decide", json=report(step=step))
        ready = wait_for(alone, "degraded")
        sources = [pair.post("/decide", json=report(step=step)).json()["source"] for step in range(12)]
    assert "violates our content policy" in ready["detail"]
    assert KEY not in ready["detail"]
    assert sources[-6:] == ["llm"] * 6


def test_a_failure_names_the_servers_reason(edge: Edge) -> None:
    app = FastAPI()
    app.post("/v1/chat/completions")(lambda: RedirectResponse("http://elsewhere.example/v1/chat/completions?key=1"))
    app.post("/azure/chat/completions")(lambda: JSONResponse({"error": "Unexpected endpoint (POST /chat)"}))
    app.post("/html/chat/completions")(lambda: Response("<html><h1>502</h1> Bad gateway</html>", 502))
    expected = {
        "v1": "HTTP 307 to http://elsewhere.example/v1/chat/completions",
        "azure": "Unexpected endpoint (POST /chat)",
        "html": "HTTP 502: 502 Bad gateway",
    }
    with serving(app) as url:
        for path, words in expected.items():
            client = edge(mode="llm", llm_url=f"{url}/{path}", llm_model="stub-1")
            assert words in wait_for(client, "unavailable")["detail"]


def test_a_connection_that_was_closed_while_idle_costs_no_decision(edge: Edge, report: Report) -> None:
    """Each connection answers one request and is closed without an answer at the second (aiohttp 9138)."""
    closed = 0

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal closed
        for answers in (True, False):
            head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
            length = int(head.split("content-length:")[1].split("\r\n")[0])
            await reader.readexactly(length)
            if not answers:
                closed += 1
                writer.transport.abort()
                return
            answer = json.dumps({"choices": [{"message": {"content": "0 7"}}]}).encode()
            writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(answer), answer))
            await writer.drain()

    with listening(handler) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        sources = [client.post("/decide", json=report(step=step)).json()["source"] for step in range(6)]
    assert sources == ["llm"] * 6
    assert closed >= 3


def test_a_renamed_model_is_asked_for_again(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.llm.usability.FIRST_UNUSABLE_S", 0.1)
    name = "old"

    def knows_one_model(body: Body) -> Response | str:
        known = body.get("model") == name
        return "0 7" if known else refused(f"The model '{body.get('model')}' does not exist", "model", 404)

    server = Plain(knows_one_model)
    app = FastAPI()
    app.get("/v1/models")(lambda: {"data": [{"id": name}]})
    app.post("/v1/chat/completions")(server.complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["model"] == "old"
        name = "new"
        for step in range(5):
            assert client.post("/decide", json=report(step=step)).json()["reason"] == "llm_status"
        until(lambda: client.get("/readyz").json()["model"] == "new")
        assert wait_for(client, "ready")["detail"] is None
        assert client.post("/decide", json=report(step=5)).json()["source"] == "llm"


@pytest.mark.parametrize("pause", ["0.2", "Sat, 28 Nov 2020 06:00:00 GMT"])
def test_a_pause_that_the_deadline_leaves_time_for_is_obeyed(edge: Edge, report: Report, pause: str) -> None:
    """429 with ``Retry-After``, in seconds or as a date: RFC 9110, 10.2.3; OpenAI, Anthropic and Azure send it."""
    busy = False

    def limits_its_rate(body: Body) -> Response | str:
        nonlocal busy
        busy = not busy and body["messages"][-1]["content"] not in ("Say hello.", FIRST)
        return Response("{}", 429, {"Retry-After": pause}) if busy else "0 7"

    with serving(Plain(limits_its_rate).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", deadline_ms=30_000)
        wait_for(client, "ready")
        sources = [client.post("/decide", json=report(step=step)).json()["source"] for step in range(3)]
    assert sources == ["llm"] * 3


def test_a_server_is_left_alone_for_the_pause_that_it_asks_for(edge: Edge, report: Report) -> None:
    real = 0

    def has_no_quota(body: Body) -> Response | str:
        nonlocal real
        if body["messages"][-1]["content"] in ("Say hello.", FIRST):
            return "0 7"
        real += 1
        error = {"error": {"message": "You exceeded your current quota"}}
        return JSONResponse(error, 429, {"Retry-After": "3600"})

    with serving(Plain(has_no_quota).app) as url, serving(Plain(lambda body: "0 7").app) as spare:
        alone = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(alone, "ready")
        answers = [alone.post("/decide", json=report(step=step)).json() for step in range(5)]
        ready = wait_for(alone, "degraded")
        pair = edge(mode="llm", llm_url=f"{url}/v1,{spare}/v1")
        standing_by(pair, 1)
        sources = [pair.post("/decide", json=report(step=step)).json()["source"] for step in range(3)]
    assert [answer["reason"] for answer in answers] == ["llm_status"] * 5
    assert "exceeded your current quota (no requests for 480 s)" in ready["detail"]
    assert sources == ["llm"] * 3
    # One request of each edge.
    assert real == 2


def test_readyz_says_how_the_server_answers_and_what_it_demands(edge: Edge) -> None:
    def thinks_at_length(body: Body) -> Response | str:
        if "max_tokens" in body:
            return refused("Use 'max_completion_tokens' instead of max_tokens.", "max_tokens")
        if body["max_completion_tokens"] < 1024:
            return JSONResponse({"choices": [{"message": {"content": ""}, "finish_reason": "length"}]})
        return "<think>far</think>0 7"

    with serving(Plain(thinks_at_length).app) as url:
        ready = wait_for(edge(mode="llm", llm_url=f"{url}/v1"), "ready")
    demands = "with max_completion_tokens, 1024 tokens of thought"
    assert (
        ready["abilities"] == f"answers as text that the edge checks, no token probabilities, one UAV a call; {demands}"
    )
    assert ready["decision_ms"] > 0


def test_a_server_whose_first_answer_is_of_no_use_has_no_decision_to_time(edge: Edge) -> None:
    with serving(Plain(lambda body: "no idea").app) as url:
        assert wait_for(edge(mode="llm", llm_url=f"{url}/v1"), "ready")["decision_ms"] is None


def test_a_decision_that_takes_longer_than_the_deadline_is_warned_of(
    edge: Edge, caplog: pytest.LogCaptureFixture
) -> None:
    def thinks_slowly(body: Body) -> str:
        time.sleep(0.05)
        return "0 7"

    with serving(Plain(thinks_slowly).app) as url:
        ready = wait_for(edge(mode="llm", llm_url=f"{url}/v1", deadline_ms=10), "ready")
    assert ready["decision_ms"] >= 50
    assert "LLM too slow: a decision took" in caplog.text
