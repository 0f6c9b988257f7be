"""A real HTTP upstream that obeys, or misbehaves in every way that one can: the UAV is always answered."""

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response

from tests.support.running import listening, serving
from tests.support.stub_llm import FAULTS, FLOODS, PROBE, StubLlm, chat_completion, http_answer, misbehaving, wait_for
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


class Model(StubLlm):
    """Obeys one of the ways to constrain an answer; ``refuses`` the requests that have another."""

    def __init__(self, obeys: str, answer: str = "0 7", refuses: bool = False) -> None:
        super().__init__(answer)
        self.obeys, self.refuses = obeys, refuses

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        ways = {"grammar", "structured_outputs", "response_format"} & body.keys()
        if self.refuses and ways - {self.obeys}:
            return JSONResponse({"error": "unknown field"}, status_code=400)
        usage = {"prompt_tokens": 300, "completion_tokens": 4, "prompt_tokens_details": {"cached_tokens": 250}}
        hello = f"{PROBE} 0" if self.obeys in ways else "hello"
        return chat_completion(hello if probed else self.answer, usage)


@pytest.mark.parametrize(
    ("obeys", "refuses", "constraint"),
    [
        ("grammar", False, "grammar"),
        ("structured_outputs", False, "structured_outputs"),
        ("response_format", True, "json_schema"),
        ("nothing", False, "none"),
        ("nothing", True, "none"),
    ],
)
def test_learns_what_a_server_really_obeys(
    edge: Edge, report: Report, obeys: str, refuses: bool, constraint: str
) -> None:
    model = Model(obeys, refuses=refuses)
    with serving(model.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", price_input=1.0, price_cached=0.5, price_output=2.0)
        ready = wait_for(client, "ready")
        assert (ready["constraint"], ready["model"]) == (constraint, "stub-1")
        answer = client.post("/decide", json=report()).json()
    assert (answer["source"], answer["reason"], answer["model"]) == ("llm", None, "stub-1")
    assert (answer["sensor_id"], answer["velocity"]) == (0, 7)
    tokens = answer["tokens"]
    assert (tokens["server_prompt"], tokens["cached"], tokens["completion"]) == (300, 250, 4)
    assert tokens["cost_usd"] == pytest.approx((50 * 1.0 + 250 * 0.5 + 4 * 2.0) / 1e6)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("4 7", "answer_sensor"), ("0 15", "answer_velocity"), ("I would fly to sensor 0.", "answer_format")],
)
def test_an_answer_is_checked_whatever_the_server_promised(edge: Edge, report: Report, text: str, reason: str) -> None:
    with serving(Model("grammar", answer=text).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        answer = client.post("/decide", json=report()).json()
        metrics = client.get("/metrics").text
    assert (answer["source"], answer["reason"]) == ("policy", reason)
    assert answer["sensor_id"] in [0, 1, 2, 3]
    assert f'aicvds_llm_requests_total{{outcome="{reason}"}} 1.0' in metrics


@pytest.fixture(params=FAULTS | FLOODS)
def faulty(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    fault, reason = (FAULTS | FLOODS)[request.param]
    with ExitStack() as stack:
        yield stack.enter_context(listening(misbehaving(fault))), reason


def test_a_misbehaving_upstream_never_keeps_a_uav_waiting(edge: Edge, report: Report, faulty: tuple[str, str]) -> None:
    url, reason = faulty
    # Only who waits for the deadline needs a short one; the others must not meet it on a slow machine.
    deadline_ms = 100 if reason == "llm_timeout" else 60_000
    client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1", deadline_ms=deadline_ms)
    wait_for(client, "ready")
    answers = [client.post("/decide", json=report(uav_id=uav)) for uav in range(3)]
    assert [a.status_code for a in answers] == [200] * 3
    assert {a.json()["reason"] for a in answers} == {reason}
    assert len({a.json()["sensor_id"] for a in answers}) == 3


@pytest.mark.parametrize("prompt_tokens", [b"-3", b"1" + b"0" * 400, b"true", b"null"])
def test_a_usage_that_makes_no_sense_is_no_usage(edge: Edge, report: Report, prompt_tokens: bytes) -> None:
    usage = (
        b'{"prompt_tokens": %s, "completion_tokens": "x", "prompt_tokens_details": {"cached_tokens": 1.5}}'
        % prompt_tokens
    )
    answer = b'{"choices": [{"message": {"content": "0 7"}}], "usage": %s}' % usage
    with listening(misbehaving(http_answer(b"200 OK", answer))) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        decision = client.post("/decide", json=report()).json()
    assert decision["source"] == "llm"
    assert [decision["tokens"][key] for key in ("server_prompt", "cached", "completion")] == [None] * 3


class Proxied(StubLlm):
    """Obeys a grammar, and gives its own ``fault`` for every request that has one of these fields.

    So LiteLLM's proxy before llama.cpp was seen to do with ``post_sampling_probs``, by 500; see
    :mod:`service.llm.probing` for others.
    """

    def __init__(self, fault: Response, *fields: str) -> None:
        super().__init__("0 7")
        self.fault, self.fields = fault, set(fields)

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        if self.fields & body.keys():
            return self.fault
        held = "grammar" in body
        labels = 'root ::= "A"' in body.get("grammar", "") or body["max_tokens"] == 1
        return chat_completion(
            (f"{PROBE} 0" if held else "hello") if probed and not labels else "A" if labels else self.answer
        )


_HELD = ("grammar", "structured_outputs", "response_format")
_REFUSALS: list[tuple[Response, tuple[str, ...], str]] = [
    (JSONResponse({"error": "cannot parse"}, 500), ("post_sampling_probs", "top_logprobs"), "grammar"),
    (JSONResponse({"error": "not implemented"}, 501), ("logprobs",), "grammar"),
    (JSONResponse({"error": "unknown field"}, 500), _HELD, "none"),
    (JSONResponse({"error": "forbidden"}, 403), (*_HELD, "logprobs"), "none"),
    # Nobody named these.
    (Response("<html>Bad Gateway</html>", 502, media_type="text/html"), (*_HELD, "logprobs"), "none"),
    (Response("no JSON at all"), ("logprobs", "grammar"), "none"),
    (JSONResponse({"choices": []}), ("structured_outputs", "logprobs"), "grammar"),
    (JSONResponse({"choices": [{"message": {"content": None}}]}), _HELD, "none"),
]


@pytest.mark.parametrize("mode", ["llm", "guided"])
@pytest.mark.parametrize(("fault", "fields", "constraint"), _REFUSALS)
def test_what_a_server_cannot_do_keeps_it_from_nothing_else(
    edge: Edge, report: Report, mode: str, fault: Response, fields: tuple[str, ...], constraint: str
) -> None:
    with serving(Proxied(fault, *fields).app) as url:
        client = edge(mode=mode, llm_url=f"{url}/v1", planner="off")
        assert wait_for(client, "ready")["constraint"] == constraint
        answer = client.post("/decide", json=report()).json()
    assert (answer["source"], answer["reason"]) == (mode, None)


@pytest.mark.parametrize("mode", ["llm", "guided"])
@pytest.mark.parametrize(
    ("status", "said_instead", "quoted"),
    [
        (200, "Certainly! I would collect\nfrom", "Certainly! I would collect"),
        (200, "\x1b[31m<script>" + "x" * 5000, "<script>"),
        (400, "the prompt is too long", "HTTP 400"),
    ],
)
def test_a_server_whose_answers_cannot_be_used_is_degraded(
    edge: Edge, report: Report, caplog: pytest.LogCaptureFixture, mode: str, status: int, said_instead: str, quoted: str
) -> None:
    model = Model("grammar")
    answers = model.respond
    usable = True

    async def respond(body: dict[str, Any], probed: bool) -> Response:
        if probed or usable:
            model.answer = "A" if mode == "guided" else "0 7"
            return await answers(body, probed)
        return chat_completion(said_instead) if status == 200 else JSONResponse({"error": said_instead}, status)

    model.respond = respond  # type: ignore[method-assign]
    with serving(model.app) as url:
        client = edge(mode=mode, llm_url=f"{url}/v1", planner="off")
        wait_for(client, "ready")
        usable = False
        for step in range(4):
            client.post("/decide", json=report(step=step))
        assert client.get("/readyz").json()["llm"] == "ready"
        for step in range(4, 12):
            assert client.post("/decide", json=report(step=step)).json()["source"] != "llm"
        found = client.get("/readyz").raise_for_status().json()
        assert found["ready"] and found["llm"] == "degraded" and quoted in found["detail"]
        assert found["detail"].startswith("12 answers in a row cannot be used") and len(found["detail"]) < 400
        lines = [line.message for line in caplog.records if "LLM degraded" in line.message]
        assert len(lines) == 1 and quoted in lines[0] and lines[0].isprintable()
        usable = True
        assert client.post("/decide", json=report(step=12)).json()["source"] == mode
        assert client.get("/readyz").json()["llm"] == "ready"


@pytest.mark.parametrize("named", ["socks5://127.0.0.1:1", "gopher://x", "http://x:port"])
def test_a_proxy_that_cannot_be_used_is_said(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    # In the environment it would be for the test's own client too.
    monkeypatch.setattr("service.llm.client.getproxies", lambda: {"all": named})
    client = edge(mode="llm", llm_url="http://llm.example/v1", llm_model="m")
    assert "proxy of the environment" in wait_for(client, "unavailable")["detail"]
    assert client.post("/decide", json=report()).status_code == 200


@pytest.mark.parametrize("status", [503, 429])
def test_a_server_that_is_still_loading_is_probed_again(
    edge: Edge, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    """A refusal for want of time says nothing about what the server obeys."""
    monkeypatch.setattr("service.llm.server.RETRY_S", 0.05)
    model = Model("grammar")
    complete, early = model.complete, [status] * 3

    async def loading(request: Request) -> Response:
        return JSONResponse({}, status_code=early.pop()) if early else await complete(request)

    app = FastAPI()
    app.get("/v1/models")(model.models)
    app.post("/v1/chat/completions")(loading)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        ready = wait_for(client, "ready")
    assert (ready["llm"], ready["constraint"]) == ("ready", "grammar")


def test_a_server_that_lists_its_model_only_once_it_has_loaded_it_is_named(edge: Edge, report: Report) -> None:
    """As llama.cpp answers 503 while it loads, and may be ready before the next request."""
    model, early = Model("grammar"), [503]

    async def loading() -> Response:
        return JSONResponse({}, status_code=early.pop()) if early else JSONResponse(await model.models())

    app = FastAPI()
    app.get("/v1/models")(loading)
    app.post("/v1/chat/completions")(model.complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["model"] == client.post("/decide", json=report()).json()["model"] == "stub-1"


def test_a_server_that_goes_away_is_told_and_found_again(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.llm.server.RETRY_S", 0.05)
    with serving(Model("grammar").app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
    answers = [client.post("/decide", json=report(uav_id=uav)).json()["reason"] for uav in (0, 1)]
    assert answers[-1] == "llm_unavailable"
    wait_for(client, "unavailable")
    with serving(Model("grammar").app, port=int(url.rsplit(":", 1)[1])):
        wait_for(client, "ready")
        assert client.post("/decide", json=report(step=1)).json()["source"] == "llm"


@pytest.mark.parametrize("models", [{"data": [{"id": "\ud800"}]}, {"data": [{"id": None}]}, {"data": 7}, []])
def test_a_list_of_models_that_is_none(edge: Edge, report: Report, models: Any) -> None:
    app = FastAPI()
    app.get("/v1/models")(lambda: Response(json.dumps(models), media_type="application/json"))
    app.post("/v1/chat/completions")(Model("grammar").complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        until(lambda: client.get("/readyz").raise_for_status().json()["llm"] != "loading")
        assert client.post("/decide", json=report()).status_code == 200


@pytest.mark.parametrize(("more", "model"), [([], None), (["stub-2", "stub-3"], "stub-2")])
def test_a_model_is_called_by_a_name_of_bounded_length(
    edge: Edge, report: Report, caplog: pytest.LogCaptureFixture, more: list[str], model: str | None
) -> None:
    caplog.set_level("INFO", "service")
    app = FastAPI()
    listed = {"data": [{"id": name} for name in ["M" * 201, "\ud800", 7, *more]]}
    app.get("/v1/models")(lambda: Response(json.dumps(listed), media_type="application/json"))
    app.post("/v1/chat/completions")(Model("grammar").complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        ready = wait_for(client, "ready")
        assert ready["model"] == model
        # Without a usable name requests name none, and the server uses its own default.
        assert ("no model has a name that can be used" in caplog.text) == (model is None)
        assert client.post("/decide", json=report()).json()["source"] == "llm"


@pytest.mark.parametrize("second", ["decider", "nomic-embed-text"])
def test_of_several_listed_models_the_first_is_used_and_the_log_names_all(
    edge: Edge, caplog: pytest.LogCaptureFixture, second: str
) -> None:
    """vLLM lists its model before the model's adapters, and LiteLLM's proxy all that it serves."""
    app = FastAPI()
    app.get("/v1/models")(lambda: {"data": [{"id": "bare"}, {"id": second}]})
    app.post("/v1/chat/completions")(Model("grammar").complete)
    with serving(app) as url:
        assert wait_for(edge(mode="llm", llm_url=f"{url}/v1"), "ready")["model"] == "bare"
    warned = [line.getMessage() for line in caplog.records if "AICVDS_LLM_MODEL" in line.getMessage()]
    # One of the two cannot chat, so there is no choice.
    assert warned == (
        ["of the listed models the first is used: ['bare', 'decider']; AICVDS_LLM_MODEL names another"]
        if second == "decider"
        else []
    )


def test_a_timed_out_call_is_hung_up(edge: Edge, report: Report) -> None:
    """The server learns at once that nobody waits any longer, and can free its slot."""
    hung_up = []

    async def watching(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        hung_up.append(await reader.read())

    with listening(misbehaving(watching)) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", llm_model="stub-1", deadline_ms=200)
        wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["reason"] == "llm_timeout"
        until(lambda: hung_up)
    assert hung_up == [b""]


def test_an_upstream_that_is_down_is_tried_again(edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.llm.server.RETRY_S", 0.1)
    with serving(Model("grammar").app) as url:
        port = int(url.rsplit(":", 1)[1])
    client = edge(mode="llm", llm_url=f"{url}/v1")
    ready = wait_for(client, "unavailable")
    assert str(port) in ready["detail"]
    assert client.post("/decide", json=report()).json()["reason"] == "llm_unavailable"


def test_without_its_model_file_the_edge_flies_on_and_says_what_to_run(
    edge: Edge, report: Report, tmp_path: Any
) -> None:
    client = edge(mode="llm", llm_gguf=tmp_path / "none.gguf")
    assert "AICVDS_LLM_GGUF" in wait_for(client, "unavailable")["detail"]
    assert client.post("/decide", json=report()).json()["reason"] == "llm_unavailable"
    (tmp_path / "junk.gguf").write_bytes(b"GGUF" + b"\0" * 1000)
    client = edge(mode="llm", llm_gguf=tmp_path / "junk.gguf")
    wait_for(client, "unavailable")
    assert client.post("/decide", json=report()).status_code == 200


def test_a_server_is_asked_by_the_proxy_that_the_environment_names(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, str]] = []

    class Proxy(StubLlm):
        async def complete(self, request: Request) -> Response:
            asked.append((request.headers["host"], request.headers.get("proxy-authorization", "")))
            return await super().complete(request)

    with serving(Proxy().app) as url:
        monkeypatch.setenv("HTTP_PROXY", url.replace("http://", "http://user:word@"))
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        client = edge(mode="llm", llm_url="http://llm.invalid/v1")
        wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["source"] == "llm"
    assert set(asked) == {("llm.invalid", "Basic dXNlcjp3b3Jk")}
