"""Servers in place of an LLM: one answers a uniform draw of the allowed answers, one the worst of them.

The losses of a scheme with them show the contribution of everything but the LLM, which an LLM must beat.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

Answer = Callable[[dict[str, Any]], str]

# A sensor and a velocity (mode llm), or one letter (mode guided).
_PAIR = re.compile(r"root ::= \(([^)]*)\) \" \" \(([^)]*)\)")
_LABEL = re.compile(r'root ::= ("[A-Z]"(?: \| "[A-Z]")*)')
# A sensor's ID and its distance, the fifth number of its row.
_PLACED = re.compile(r"^(\d+),-?\d+,-?\d+,-?\d+,(\d+)\b", re.MULTILINE)
_ROW = re.compile(r"^([A-Z])(\d+),", re.MULTILINE)


def drawn(body: dict[str, Any]) -> str:
    """A uniform draw of the answers that the request's grammar allows; the same request gets the same answer.

    Raises:
        ValueError: the request has no grammar such as ``root ::= ("3" | "5") " " ("0" | "1")`` or
            ``root ::= "A" | "B"``.
    """
    grammar = body.get("grammar")
    allowed = grammar if isinstance(grammar, str) else ""
    found = _PAIR.fullmatch(allowed) or _LABEL.fullmatch(allowed)
    if not found:
        raise ValueError("only requests with a grammar of two numbers or of one letter are answered")
    digest = hashlib.sha256(json.dumps(body.get("messages")).encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8]))
    return " ".join(str(rng.choice(re.findall(r'"(\w+)"', group))) for group in found.groups())


def worst(body: dict[str, Any]) -> str:
    """In mode ``guided`` the emptiest queue at its highest velocity; in ``llm`` the farthest sensor at velocity 0.

    Other requests, such as an edge's probe of the grammar, are answered by a draw.

    Raises:
        ValueError: as :func:`drawn`.
    """
    grammar = body.get("grammar")
    allowed = grammar if isinstance(grammar, str) else ""
    if pair := _PAIR.fullmatch(allowed):
        far = {i: int(metres) for i, metres in _PLACED.findall(body["messages"][-1]["content"]) if f'"{i}"' in pair[1]}
        return f"{max(far, key=lambda i: far[i])} 0" if far else drawn(body)
    found = _LABEL.fullmatch(allowed)
    if not found:
        return drawn(body)
    letters: list[str] = re.findall(r'"([A-Z])"', found[1])
    rows = {letter: int(queue) for letter, queue in _ROW.findall(body["messages"][-1]["content"]) if letter in letters}
    if not rows:
        return letters[-1]
    emptiest = min(rows, key=lambda letter: rows[letter])
    later = [letter for letter in rows if letter > emptiest]
    return [letter for letter in letters if letter < (min(later) if later else "[")][-1]


# The model names of the stand-ins.
NAMES: dict[Answer, str] = {drawn: "uniform draws", worst: "the worst"}


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    # A buffer sends head and body in one segment: else the body waits up to 40 ms for the head's delayed ACK.
    wbufsize = -1
    answer: Answer

    def do_GET(self) -> None:
        self._answer(
            200, {"object": "list", "data": [{"id": NAMES.get(type(self).answer, "stand-in"), "object": "model"}]}
        )

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers.get("Content-Length", 0))))
        try:
            message = {"role": "assistant", "content": type(self).answer(body)}
        except ValueError as error:
            return self._answer(400, {"error": {"message": str(error)}})
        self._answer(200, {"choices": [{"index": 0, "message": message, "finish_reason": "stop"}]})
        return None

    def _answer(self, status: int, body: dict[str, Any]) -> None:
        content = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def answering(answer: Answer) -> Iterator[str]:
    """Within the context, run the server on a free loopback port; yields its base URL up to and including ``/v1``."""
    handler = type("Handler", (_Handler,), {"answer": staticmethod(answer)})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/v1"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
