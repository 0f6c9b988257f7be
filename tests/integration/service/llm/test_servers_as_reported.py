"""LLM servers as public reports describe them; each behaviour names its report, or says that it is our own."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.responses import JSONResponse, Response

from tests.integration.service.llm.test_servers_as_seen import Behaviour, Body, Plain, refused
from tests.support.running import serving
from tests.support.stub_llm import FIRST, chat_completion, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def with_message(finish_reason: str = "stop", **message: Any) -> Response:
    """A completion with these fields of the message."""
    return JSONResponse({"choices": [{"message": {"role": "assistant", **message}, "finish_reason": finish_reason}]})


def answers_where_its_thoughts_belong(body: Body) -> Response:
    """0xPlaygrounds/rig#1656, lmstudio-ai/lmstudio-bug-tracker#1602"""
    return with_message(content="", reasoning_content="0 7")


def answers_null_where_its_thoughts_are(body: Body) -> Response:
    """Birfy/agentdescent#11, mgechev/skillgrade#22"""
    return with_message(content=None, reasoning="<think>Sensor 0.</think>\n0 7")


def wants_at_least_16_tokens(body: Body) -> Response | str:
    """dotnet/extensions#6945, braintrustdata/lingua#186"""
    if body.get("max_tokens", 16) < 16:
        return refused(
            f"Invalid 'max_completion_tokens': integer below minimum value. Expected a value >= 16, but got "
            f"{body['max_tokens']} instead.",
            "max_completion_tokens",
        )
    return "0 7"


def cannot_finish_in_so_few_tokens(body: Body) -> Response | str:
    """steipete/CodexBar#2867"""
    if body.get("max_tokens", 64) < 64:
        words = "Could not finish the message because max_tokens or model output limit was reached. Please try again "
        return refused(words + "with higher max_tokens.")
    return "0 7"


def streams_although_it_was_told_not_to(body: Body) -> Response:
    """unslothai/unsloth#6570"""
    deltas = [{"role": "assistant", "content": ""}, {"content": "0"}, {"content": " 7"}, {}]
    chunks: list[Body] = [
        {"object": "chat.completion.chunk", "choices": [{"delta": delta, "index": 0}]} for delta in deltas
    ]
    chunks.append({"choices": [], "usage": {"prompt_tokens": 9, "completion_tokens": 3}})
    text = ": keep-alive\n\n" + "".join(f"data: {json.dumps(chunk)}\n\n" for chunk in chunks) + "data: [DONE]\n\n"
    return Response(text, media_type="text/event-stream")


def streams_with_other_line_ends(body: Body) -> Response:
    """Own: the event stream's lines may end by CRLF, and need no blank after the colon."""
    chunk = {"choices": [{"delta": {"content": "0 7"}, "finish_reason": "stop"}]}
    return Response(f"event: message\r\ndata:{json.dumps(chunk)}\r\n\r\ndata:[DONE]\r\n\r\n")


def ends_its_json_as_a_stream(body: Body) -> Response:
    """decolua/9router#3492"""
    whole = {"object": "chat.completion", "choices": [{"message": {"content": "0 7"}}]}
    return Response(f"{json.dumps(whole)}\n\ndata: [DONE]\n\n", media_type="text/event-stream")


def gives_a_delta_for_a_message(body: Body) -> Response:
    """gumieri/nenya#19"""
    return JSONResponse({"object": "chat.completion", "choices": [{"delta": {"content": "0 7"}, "index": 0}]})


def gives_a_text_for_a_message(body: Body) -> Response:
    """vllm-project/vllm#13197: the shape of the older completions."""
    return JSONResponse({"object": "text_completion", "choices": [{"text": "0 7", "index": 0}]})


def thinks_only_in_streams(body: Body) -> Response:
    """tencentmusic/supersonic#2355, langchain4j/langchain4j#3974"""
    if not body["stream"]:
        return refused("parameter.enable_thinking must be set to false for non-streaming calls")
    return streams_although_it_was_told_not_to(body)


def streams_only(body: Body) -> Response:
    """musistudio/claude-code-router#948"""
    if not body["stream"]:
        return refused("enable thinking can not be support when `stream=False`.")
    return streams_although_it_was_told_not_to(body)


def writes_its_channels(body: Body) -> str:
    """ml-explore/mlx-lm#1867, kekzl/imp#768: gpt-oss."""
    return (
        "<|channel|>analysis<|message|>Sensor 3 at 7 would be worse.<|end|>"
        "<|start|>assistant<|channel|>final<|message|>0 7<|return|>"
    )


def writes_its_channels_otherwise(body: Body) -> str:
    """openai/harmony#56"""
    answer = '{"sensor_id": 0, "velocity": 7}'
    return f"analysis<|message|>Hm.<|end|><|start|>assistant<|channel|>final json<|message|>{answer}<|end|>"


def is_cut_off_within_its_channels(body: Body) -> Response:
    """ml-explore/mlx-lm#1867"""
    if body["max_tokens"] < 200:
        return chat_completion("<|channel|>analysis<|message|>Sensor 3", finish_reason="length")
    return chat_completion(
        "<|channel|>analysis<|message|>Sensor 3.<|end|><|start|>assistant<|channel|>final<|message|>0 7"
    )


def ends_with_a_special_token(body: Body) -> str:
    """ggml-org/llama.cpp#6924"""
    return "0 7<|im_end|>"


def ends_with_many_special_tokens(body: Body) -> str:
    """deepseek-ai/DeepSeek-Coder#136"""
    return "0 7\n<|EOT|>\n<|EOT|>\n<｜end▁of▁sentence｜></s><end_of_turn>"


def thinks_in_brackets(body: Body) -> str:
    """RooCodeInc/Roo-Code#8522: Magistral."""
    return "[THINK]Sensor 3 at 7?[/THINK]0 7"


def thinks_in_other_tags_and_answers_in_a_box(body: Body) -> str:
    """tinyhumansai/openhuman#6184: EXAONE Deep."""
    return "<thought>\nSensor 3 at 7?\n</thought>\n\n\\boxed{0 7}"


def reasons_in_tags(body: Body) -> str:
    """tinyhumansai/openhuman#6184"""
    return "<reasoning>Sensor 3 at 7?</reasoning> 0 7"


def emphasises_its_answer(body: Body) -> str:
    """Own: Markdown."""
    return "**0 7**"


def quotes_its_answer(body: Body) -> str:
    """Own: a JSON string."""
    return '"0 7"'


def separates_by_odd_blanks(body: Body) -> str:
    """Own: a byte order mark, a no-break space and a blank of no width."""
    return "\ufeff0\u00a07\u200b"


def answers_by_a_tool_call(body: Body) -> Response:
    """BerriAI/litellm#6741"""
    function = {"name": "json_tool_call", "arguments": '{"sensor_id": 0, "velocity": 7}'}
    return with_message("tool_calls", content=None, tool_calls=[{"type": "function", "function": function}])


def parses_its_json(body: Body) -> Response:
    """Own: the content is the object, not its text."""
    return with_message(content={"sensor_id": 0, "velocity": 7})


def wants_a_positive_temperature(body: Body) -> Response | str:
    """huggingface/text-generation-inference#1236, ai-forever/gigachain#237"""
    if body.get("temperature") == 0:
        words = "Input validation error: `temperature` must be strictly positive"
        return JSONResponse({"error": words, "error_type": "validation"}, 422)
    return "0 7"


def forbids_a_field_in_nested_json(body: Body) -> Response | str:
    """mistralai/platform-docs-public#7"""
    if "temperature" in body:
        detail = [{"type": "extra_forbidden", "loc": ["body", "temperature"], "msg": "Extra inputs are not permitted"}]
        return JSONResponse({"object": "error", "message": json.dumps({"detail": detail}), "param": None}, 422)
    return "0 7"


def knows_no_other_argument(body: Body) -> Response | str:
    """zed-industries/zed#52000"""
    usual = {"messages", "temperature", "max_tokens", "stream", "model"}
    others = sorted(body.keys() - usual)
    return refused(f"Unrecognized request argument supplied: {others[0]}") if others else "0 7"


def created(body: Body) -> Response:
    """Own: a gateway that answers each POST by 201."""
    return JSONResponse({"choices": [{"message": {"content": "0 7"}}]}, 201)


READABLE: list[Behaviour] = [
    answers_where_its_thoughts_belong,
    answers_null_where_its_thoughts_are,
    wants_at_least_16_tokens,
    cannot_finish_in_so_few_tokens,
    streams_although_it_was_told_not_to,
    streams_with_other_line_ends,
    ends_its_json_as_a_stream,
    gives_a_delta_for_a_message,
    gives_a_text_for_a_message,
    thinks_only_in_streams,
    streams_only,
    writes_its_channels,
    writes_its_channels_otherwise,
    is_cut_off_within_its_channels,
    ends_with_a_special_token,
    ends_with_many_special_tokens,
    thinks_in_brackets,
    thinks_in_other_tags_and_answers_in_a_box,
    reasons_in_tags,
    emphasises_its_answer,
    quotes_its_answer,
    separates_by_odd_blanks,
    answers_by_a_tool_call,
    parses_its_json,
    wants_a_positive_temperature,
    forbids_a_field_in_nested_json,
    knows_no_other_argument,
    created,
]


@pytest.mark.parametrize("behaviour", READABLE, ids=lambda behaviour: behaviour.__name__)
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


def fails_within_a_200(body: Body) -> Response:
    """nodetool-ai/nodetool#5755: OpenRouter."""
    return JSONResponse({"error": {"code": 402, "message": "This request requires more credits"}, "user_id": "u"})


def fails_within_a_choice(body: Body) -> Response:
    """nodetool-ai/nodetool#5755"""
    error = {"code": 502, "message": "This request requires more credits"}
    choice = {"finish_reason": "error", "error": error, "message": {"content": ""}}
    return JSONResponse({"choices": [choice]})


def filters_by_a_completion(body: Body) -> Response:
    """experientiallabs/experiential#967: Azure AI Foundry answers 400 with a completion."""
    results = {"error": {"code": "content_filter", "message": "This request requires more credits"}}
    choice = {"message": {"content": ""}, "finish_reason": "content_filter", "content_filter_results": results}
    return JSONResponse({"choices": [choice], "object": "chat.completion"}, 400)


def filters_silently(body: Body) -> Response:
    """diegosouzapw/OmniRoute#7973, stanford-crfm/helm#3327"""
    return with_message("content_filter", content="")


def refuses_politely(body: Body) -> Response:
    """Own: OpenAI's field for refusals."""
    return with_message(content=None, refusal="This request requires more credits")


def has_no_choices(body: Body) -> Response:
    """BerriAI/litellm#40294"""
    return JSONResponse({"id": "1", "choices": [], "usage": {"prompt_tokens": 19, "completion_tokens": 0}})


def has_null_choices(body: Body) -> Response:
    """maximhq/bifrost#5963, langchain-ai/langchain#20936"""
    return JSONResponse({"id": "", "model": "", "choices": None, "usage": None})


def is_switched_off(body: Body) -> str:
    """BaseIntelligence/bounty-challenge#16336"""
    return "This request requires more credits. Chat completions API endpoint is temporarily disabled."


def says_nothing(body: Body) -> str:
    """abetlen/llama-cpp-python#1195"""
    return ""


def cannot_chat(body: Body) -> Response:
    """osaurus-ai/osaurus#884, pgEdge/pgedge-postgres-mcp#255"""
    return refused('"nomic-embed-text:latest" does not support chat. This request requires more credits')


def thinks_without_end(body: Body) -> Response:
    """QwenLM/qwen-code#8818"""
    return chat_completion("<think>Sensor 0 at 7 or sensor 3 at 5", finish_reason="length")


def names_several(body: Body) -> str:
    """Own: no one can know which it means."""
    return "0 7\n3 5"


def writes_numbers_as_texts(body: Body) -> str:
    """Own: the decision is as strict as the schema."""
    return '{"sensor_id": "0", "velocity": "7"}'


UNREADABLE: list[Behaviour] = [
    fails_within_a_200,
    fails_within_a_choice,
    filters_by_a_completion,
    filters_silently,
    refuses_politely,
    has_no_choices,
    has_null_choices,
    is_switched_off,
    says_nothing,
    cannot_chat,
    thinks_without_end,
    names_several,
    writes_numbers_as_texts,
]
# All others give a reason, which the state must quote.
SILENT = (
    filters_silently,
    has_no_choices,
    has_null_choices,
    says_nothing,
    thinks_without_end,
    names_several,
    writes_numbers_as_texts,
)


@pytest.mark.parametrize("probes_pass", [False, True], ids=["always", "at decisions"])
@pytest.mark.parametrize("behaviour", UNREADABLE, ids=lambda behaviour: behaviour.__name__)
def test_the_state_is_said_within_five_decisions_with_a_server_that(
    behaviour: Behaviour, probes_pass: bool, edge: Edge, report: Report
) -> None:
    def answer(body: Body) -> Response | str:
        return "0 7" if probes_pass and body["messages"][-1]["content"] in ("Say hello.", FIRST) else behaviour(body)

    with serving(Plain(answer).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1", planner="off")
        while (state := client.get("/readyz").json())["llm"] == "loading":
            pass
        for step in range(5):
            decision = client.post("/decide", json=report(step=step)).json()
            assert decision["source"] == "policy"
        state = client.get("/readyz").json()
    assert state["llm"] in ("degraded", "unavailable")
    assert state["detail"]
    if behaviour not in SILENT:
        assert "requires more credits" in state["detail"]


@pytest.mark.parametrize("name", ["nomic-embed-text:latest", "text-embedding-3-large", "bge-reranker", "whisper-1"])
def test_a_listed_model_that_cannot_chat_is_passed_over(name: str, edge: Edge, report: Report) -> None:
    """odysseus-dev/odysseus#4487, open-jarvis/OpenJarvis#659, ogx-ai/ogx-client-python#66"""

    def chats(body: Body) -> Response | str:
        return refused(f'"{name}" does not support chat') if body["model"] == name else "0 7"

    app = FastAPI()
    app.get("/v1/models")(lambda: {"data": [{"id": name}, {"id": "qwen3:8b"}]})
    app.post("/v1/chat/completions")(Plain(chats).complete)
    with serving(app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["model"] == "qwen3:8b"
        assert client.post("/decide", json=report()).json()["source"] == "llm"


@pytest.mark.parametrize(
    "answer",
    [
        "A<|im_end|>",
        "[THINK]B, or A?[/THINK]\nA",
        "<|channel|>analysis<|message|>B?<|end|><|start|>assistant<|channel|>final<|message|>A<|return|>",
        "**A**",
        "\\boxed{A}",
        "\ufeffA",
    ],
)
def test_a_label_is_read_as_two_integers_are(answer: str, edge: Edge, report: Report) -> None:
    with serving(Plain(lambda body: answer).app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1", planner="off")
        wait_for(client, "ready")
        decision = client.post("/decide", json=report()).json()
    assert (decision["source"], decision["reason"]) == ("guided", None)
