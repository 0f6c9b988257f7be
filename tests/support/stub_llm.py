"""LLM servers for tests: one with given answers, and raw ones with all kinds of faults."""

from __future__ import annotations

import asyncio
import json
from functools import cache
from typing import Any

import httpx
import zstandard
from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse, Response

from tests.support.running import Handler
from tests.support.waiting import Gate, until

PROBE = "7301"
# The warm-up query of mode `llm`.
FIRST = "UAV at 500,500\n0,50,50,-90,100,1,60,40\n"


class StubLlm:
    """An OpenAI-compatible server that obeys a grammar and records its requests; subclasses define its answers."""

    def __init__(self, answer: str = "0 7") -> None:
        self.answer = answer
        self.bodies: list[dict[str, Any]] = []
        self.app = FastAPI()
        self.app.get("/v1/models")(self.models)
        self.app.post("/v1/chat/completions")(self.complete)

    async def models(self) -> dict[str, Any]:
        return {"data": [{"id": "stub-1"}]}

    async def complete(self, request: Request) -> Response:
        body = await request.json()
        self.bodies.append(body)
        return await self.respond(body, body["messages"][-1]["content"] == "Say hello.")

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        """The answer to a chat completion; ``probed`` for the edge's test whether the server obeys a grammar."""
        return chat_completion(f"{PROBE} 0" if probed else self.answer)


def chat_completion(text: str, usage: dict[str, Any] | None = None, **choice: Any) -> Response:
    """A chat completion with that text."""
    body: dict[str, Any] = {"choices": [{"message": {"content": text}, **choice}]}
    return JSONResponse(body if usage is None else {**body, "usage": usage})


def wait_for(client: httpx.Client, llm: str) -> dict[str, Any]:
    """The edge's readiness, once its LLM has the given state."""
    ready: dict[str, Any] = {}

    def reached() -> bool:
        ready.update(client.get("/readyz").json())
        return bool(ready["llm"] == llm)

    until(reached, lambda: f"the LLM is to be {llm}: {ready}")
    return ready


async def _head(reader: asyncio.StreamReader) -> dict[str, Any]:
    head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
    length = next((int(line.split(":")[1]) for line in head.split("\r\n") if line.startswith("content-length:")), 0)
    body: dict[str, Any] = json.loads(await reader.readexactly(length) or b"{}")
    return body


def misbehaving(fault: Handler, probes: Gate | None = None) -> Handler:
    """A server that passes the probe, so that the edge uses it, and handles later requests by ``fault``.

    With a gate for ``probes``, it answers them once that is open.
    """

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            body = await _head(reader)
            content = body.get("messages", [{}])[-1].get("content", "")
            if body and content not in ("Say hello.", FIRST) and "N/A" not in content:
                await fault(reader, writer)
                return
            if content == "Say hello." and probes is not None:
                await probes.passed()
            text = f"{PROBE} 0" if content == "Say hello." else "0 0"
            answer = json.dumps({"choices": [{"message": {"content": text}}], "data": [{"id": "stub-1"}]}).encode()
            writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(answer), answer))
            await writer.drain()

    return handler


async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read()


async def dripping(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 1000\r\n\r\n")
    while True:
        writer.write(b" ")
        await writer.drain()
        await asyncio.sleep(0.05)


async def resetting(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.transport.abort()


async def endless(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n")
    while True:
        writer.write(b"10000\r\n" + b"x" * 0x10000 + b"\r\n")
        await writer.drain()


def endless_bytes(head: bytes, more: bytes) -> Handler:
    """Answer with ``head``, then repeat ``more`` without end."""

    async def fault(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(head)
        while True:
            writer.write(more)
            await writer.drain()

    return fault


def http_answer(status: bytes, body: bytes) -> Handler:
    async def fault(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"HTTP/1.1 %s\r\ncontent-length: %d\r\nconnection: close\r\n\r\n%s" % (status, len(body), body))
        await writer.drain()

    return fault


@cache
def bomb() -> bytes:
    """A few kilobytes that would unpack to half a gigabyte."""
    return zstandard.compress(b" " * 500_000_000)


async def _compressed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    content = bomb()
    writer.write(b"HTTP/1.1 200 OK\r\ncontent-encoding: zstd\r\ncontent-length: %d\r\n\r\n%s" % (len(content), content))
    await writer.drain()


FAULTS: dict[str, tuple[Handler, str]] = {
    "silent": (silent, "llm_timeout"),
    "dripping": (dripping, "llm_timeout"),
    "resetting": (resetting, "llm_error"),
    "endless": (endless, "llm_error"),
    "429": (http_answer(b"429 Too Many Requests", b"{}"), "llm_status"),
    "500": (http_answer(b"500 Oops", b"oops"), "llm_status"),
    "redirect": (http_answer(b"302 Found", b""), "llm_status"),
    "html": (http_answer(b"200 OK", b"<html>hello</html>"), "llm_error"),
    "truncated": (http_answer(b"200 OK", b'{"choices": [{"mess'), "llm_error"),
    "empty object": (http_answer(b"200 OK", b"{}"), "llm_error"),
    "a list": (http_answer(b"200 OK", b"[1]"), "llm_error"),
    "no text": (http_answer(b"200 OK", b'{"choices": [{"message": {"content": null}}]}'), "llm_error"),
    "compressed": (_compressed, "llm_error"),
    "not http": (http_answer(b"", b"\x00\x01"), "llm_error"),
}

_PROCESSING = b"HTTP/1.1 102 Processing\r\n\r\n" * 5000

# Endless answers that a bound on the body does not end.
FLOODS: dict[str, tuple[Handler, str]] = {
    "endless 102": (endless_bytes(b"", _PROCESSING), "llm_error"),
    "endless trailers": (
        endless_bytes(b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n0\r\n", b"x: y\r\n" * 5000),
        "llm_error",
    ),
    "endless after its answer": (
        endless_bytes(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}", _PROCESSING),
        "llm_error",
    ),
}
