"""The HTTP client alone: what it learns from a server, how much it reads, and what its errors quote."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from service.llm.answers import Busy, NoDecision, NotUnderstood
from service.llm.client import LLMClient
from service.llm.request_bodies import RequestExtras, RequestTerms

BODY: dict[str, Any] = {"messages": [], "max_tokens": 12, "temperature": 0, "stream": False}
# A status, further headers, and the answer.
Answer = tuple[int, dict[str, str], Any]
Asked = list[dict[str, Any]]


def completion(text: str, **choice: Any) -> Answer:
    return 200, {}, {"choices": [{"message": {"content": text}, **choice}]}


@asynccontextmanager
async def served(answer: Callable[[dict[str, Any]], Answer], **client: Any) -> AsyncIterator[tuple[LLMClient, Asked]]:
    """A client of a server that answers each body so, and the bodies."""
    asked: Asked = []

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
        asked.append(json.loads(await reader.readexactly(int(head.split("content-length:")[1].split("\r\n")[0]))))
        status, headers, content = answer(asked[-1])
        sent = json.dumps(content).encode()
        lines = [f"HTTP/1.1 {status} x", f"content-length: {len(sent)}", "connection: close"]
        lines += [f"{name}: {value}" for name, value in headers.items()]
        writer.write("\r\n".join([*lines, "", ""]).encode() + sent)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(handler, "127.0.0.1", 0)
    url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1"
    found = LLMClient(url, trust_env=False, **client)
    try:
        yield found, asked
    finally:
        await found.close()
        server.close()


async def test_terms_that_were_learned_are_kept_for_later_requests() -> None:
    def answer(body: dict[str, Any]) -> Answer:
        return (400, {}, {"error": "temperature is not supported"}) if "temperature" in body else completion("0 7")

    async with served(answer) as (client, asked):
        for _ in range(2):
            assert (await client.complete(BODY)).text == "0 7"
    assert ["temperature" in body for body in asked] == [True, False, False]
    assert client.terms == RequestTerms(temperature=False)


async def test_terms_that_did_not_help_are_not_kept() -> None:
    def answer(body: dict[str, Any]) -> Answer:
        return 400, {}, {"error": "temperature is not supported"}

    async with served(answer) as (client, asked):
        with pytest.raises(NotUnderstood):
            await client.complete(BODY)
    assert len(asked) == 2
    assert client.terms == RequestTerms()


@pytest.mark.parametrize(("most", "tokens"), [(0, [12]), (256, [12, 268]), (1024, [12, 268, 1036])])
async def test_tokens_for_thoughts_that_never_end_are_not_kept(most: int, tokens: list[int]) -> None:
    """Each later request would else take as long in vain."""
    extras = RequestExtras(most_tokens=most)
    async with served(lambda _: completion("<think>Hm", finish_reason="length"), extras=extras) as (client, asked):
        answer = await client.complete(BODY)
    assert answer.unfinished
    assert [body["max_tokens"] for body in asked] == tokens
    assert client.terms == RequestTerms()


async def test_a_busy_servers_words_change_no_request() -> None:
    def answer(body: dict[str, Any]) -> Answer:
        return 503, {"Retry-After": "7"}, {"error": "temperature of the GPU is too high"}

    async with served(answer) as (client, asked):
        with pytest.raises(Busy) as caught:
            await client.complete(BODY)
    assert 0.0 < caught.value.pause_s <= 7.0
    assert len(asked) == 1


async def test_a_request_that_is_not_understood_is_no_pause() -> None:
    async with served(lambda _: (400, {"Retry-After": "60"}, {"error": "no grammar"})) as (client, _):
        with pytest.raises(NotUnderstood, match="HTTP 400: no grammar$"):
            await client.complete(BODY)


@pytest.mark.parametrize(("tokens", "read"), [(12, False), (100, True)])
async def test_an_answer_may_have_8_kb_for_each_of_its_tokens(tokens: int, read: bool) -> None:
    text = "x" * 300_000
    async with served(lambda _: completion(text)) as (client, _):
        if read:
            assert (await client.complete({**BODY, "max_tokens": tokens})).text == text
        else:
            with pytest.raises(NoDecision, match="more than 262144 bytes"):
                await client.complete({**BODY, "max_tokens": tokens})


@pytest.mark.parametrize("secret", ["private-key", "private-header", "private-query"])
async def test_no_error_quotes_what_the_client_authenticates_with(secret: str) -> None:
    extras = RequestExtras(headers={"api-key": "private-header"}, query={"code": "private-query"})
    client: dict[str, Any] = {"api_key": "private-key", "extras": extras}
    for status in (200, 401, 500):
        async with served(lambda _, status=status: (status, {}, {"error": f"bad: {secret}"}), **client) as (found, _):  # type: ignore[misc]
            with pytest.raises(NoDecision, match="bad: \\*\\*\\*"):
                await found.complete(BODY)


async def test_a_redirect_is_named_without_its_query_and_not_followed() -> None:
    target = "http://127.0.0.1:9/login?token=private"
    async with served(lambda _: (307, {"Location": target}, {})) as (client, asked):
        with pytest.raises(NoDecision, match="HTTP 307 to http://127.0.0.1:9/login$"):
            await client.complete(BODY)
    assert len(asked) == 1


async def test_the_operators_fields_replace_the_edges_own() -> None:
    extras = RequestExtras(body={"temperature": 0.6, "reasoning_effort": "none"})
    async with served(lambda _: completion("0 7"), extras=extras) as (client, asked):
        await client.complete(BODY)
    assert (asked[0]["temperature"], asked[0]["reasoning_effort"]) == (0.6, "none")
