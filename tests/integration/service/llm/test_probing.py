"""How the edge finds out a server's abilities, by servers that obey half of what they are asked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi.responses import Response

from tests.support.running import serving
from tests.support.stub_llm import StubLlm, chat_completion, wait_for
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]
Body = dict[str, Any]


class LlamaCppPython(StubLlm):
    """llama-cpp-python's server, 0.3.36: a grammar is obeyed, the probabilities are from before it and all samplers."""

    async def respond(self, body: Body, probed: bool) -> Response:
        if not body.get("logprobs"):
            return await super().respond(body, probed)
        likeliest = [{"token": "H", "logprob": -2.3}, {"token": "B", "logprob": -3.0}, {"token": "A", "logprob": -3.9}]
        position = {"token": "B", "logprob": -3.0, "bytes": None, "top_logprobs": likeliest}
        return chat_completion("B", logprobs={"content": [position]})


def test_probabilities_from_before_sampling_are_not_asked_for_as_those_after_it(edge: Edge, report: Report) -> None:
    """The text would be a draw at temperature 1, where the likeliest label is wanted."""
    server = LlamaCppPython()
    with serving(server.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        ready = wait_for(client, "ready")
        known = len(server.bodies)
        assert client.post("/decide", json=report()).status_code == 200
        until(lambda: len(server.bodies) > known)
    assert "constrained by grammar, the 20 likeliest tokens" in ready["abilities"]
    assert {(body["temperature"], body.get("post_sampling_probs")) for body in server.bodies[known:]} == {(0, None)}


class WritesJson(StubLlm):
    """Knows OpenAI's ``json_schema`` alone, as Portkey's gateway 1.15.2 lets through, and small models' way with it.

    SmolLM2 behind it wrote ``spread``, 62 tokens; here a token is a word or a blank.
    """

    def __init__(self, spread: str) -> None:
        super().__init__()
        self.spread = spread

    async def respond(self, body: Body, probed: bool) -> Response:
        if "response_format" not in body:
            position = {"token": "D", "top_logprobs": [{"token": "D", "logprob": -0.3}, {"token": "A", "logprob": -2}]}
            return chat_completion("D" * body["max_tokens"], finish_reason="length", logprobs={"content": [position]})
        sensor = body["response_format"]["json_schema"]["schema"]["properties"]["sensor_id"]["enum"][0]
        text = self.spread.replace("SENSOR", str(sensor))
        cut = text[: body["max_tokens"]]
        return chat_completion(cut, finish_reason="stop" if cut == text else "length")


def test_json_that_is_spread_over_lines_is_no_thought(edge: Edge, report: Report) -> None:
    """A server that seems to think gets 256 tokens more in each request, and rambles where one letter is wanted."""
    server = WritesJson('{ "sensor_id"\n\n:\n\nSENSOR, "velocity"\n\n:\n\n0 }')
    with serving(server.app) as url:
        ready = wait_for(edge(mode="guided", llm_url=f"{url}/v1"), "ready")
        assert ready["abilities"] == "answers constrained by json_schema, the 20 likeliest tokens, one UAV a call"
        plain = edge(mode="llm", llm_url=f"{url}/v1", verify="off")
        wait_for(plain, "ready")
        assert plain.post("/decide", json=report()).json()["source"] == "llm"
    assert {body["max_tokens"] for body in server.bodies if "logprobs" in body} <= {1, 3}


@pytest.mark.parametrize("begun", ['{"sensor_id": SENSOR,', "{"])
def test_a_server_whose_json_never_ends_is_not_constrained_by_it(edge: Edge, begun: str) -> None:
    """Small models add blanks without end where a schema allows them."""
    server = WritesJson(begun + "\n" * 100_000)
    with serving(server.app) as url:
        ready = wait_for(edge(mode="guided", llm_url=f"{url}/v1"), "ready")
    assert ready["abilities"] == "answers as text that the edge checks, the 20 likeliest tokens, one UAV a call"
    assert max(body["max_tokens"] for body in server.bodies) == 128
