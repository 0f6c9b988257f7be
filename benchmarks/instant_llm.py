"""An LLM server that answers at once, so that a benchmark measures only the cost of a request.

    python -m benchmarks.instant_llm 9009

It serves chat completions as llama.cpp does, obeys a grammar by its first alternatives, and returns the last
body at ``GET /last``. It is one plain ASGI application, to use as little of the machine as possible.
"""

from __future__ import annotations

import asyncio
import json
import re
import sys

import uvicorn
from starlette.types import Receive, Scope, Send

# `root ::= ("3" | "7") " " ("0" | "1")`: the first of each.
_FIRST = re.compile(r'\("([^"]*)"')
_USAGE = {"prompt_tokens": 400, "completion_tokens": 3, "total_tokens": 403}


class App:
    """Answers every POST with a chat completion, and every GET with the last request's body."""

    def __init__(self) -> None:
        self._last = b"{}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        if scope["path"].endswith("/models"):
            answer = b'{"object":"list","data":[{"id":"instant","object":"model"}]}'
        elif scope["method"] == "GET":
            answer = self._last
        else:
            self._last = await _body(receive)
            answer = json.dumps(_completion(self._last)).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", str(len(answer)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": answer})


async def _body(receive: Receive) -> bytes:
    body = b""
    while True:
        message = await receive()
        body += bytes(message.get("body", b""))
        if not message.get("more_body", False):
            return body


def _completion(request: bytes) -> dict[str, object]:
    text = " ".join(_FIRST.findall(json.loads(request).get("grammar", ""))) or "0 0"
    choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": "stop"}
    head = {"id": "0", "object": "chat.completion", "created": 0, "model": "instant"}
    return {**head, "choices": [choice], "usage": _USAGE}


if __name__ == "__main__":
    port = int(sys.argv[1])
    config = uvicorn.Config(App(), host="127.0.0.1", port=port, log_level="warning", lifespan="off", access_log=False)
    asyncio.run(uvicorn.Server(config).serve())
