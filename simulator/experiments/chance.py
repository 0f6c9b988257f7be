"""An LLM server that knows nothing: it answers a uniform draw among what it is allowed to say.

What a scheme with it loses is what attention, masks and the top k give by themselves; an LLM must beat that.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

MODEL = "uniform draws"


def drawn(body: dict[str, Any]) -> str:
    """An answer uniform over what the request's grammar allows; the same request gets the same answer.

    Raises:
        ValueError: the request has no grammar of the form ``root ::= ("3" | "5") " " ("0" | "1")``.
    """
    grammar = body.get("grammar")
    groups = re.findall(r"\(([^)]*)\)", grammar) if isinstance(grammar, str) else []
    if len(groups) != 2:
        raise ValueError("only requests with a grammar of two numbers are answered")
    digest = hashlib.sha256(json.dumps(body.get("messages")).encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8]))
    return " ".join(str(rng.choice(re.findall(r'"(\d+)"', group))) for group in groups)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer(200, {"object": "list", "data": [{"id": MODEL, "object": "model"}]})

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers.get("Content-Length", 0))))
        try:
            message = {"role": "assistant", "content": drawn(body)}
        except ValueError as error:
            return self._answer(400, {"error": {"message": str(error)}})
        self._answer(200, {"choices": [{"index": 0, "message": message, "finish_reason": "stop"}]})

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
def answering_at_random() -> Iterator[str]:
    """Such a server on a free loopback port; yields its base URL, up to and including ``/v1``."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/v1"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
