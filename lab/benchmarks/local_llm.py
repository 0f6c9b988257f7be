"""The embedded LLM without the edge: its requests, its answers and their times."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import httpx

from service.config.settings import Settings
from service.llm.embedded import EmbeddedServer
from service.llm.model_file import embedded_model
from service.prompting.prompt import Prompt

# The limit of a call; a longer one counts as this long.
LIMIT_S = 120.0
# llama.cpp's server closes the connection after a stream without a token.
_CLOSE = {"Connection": "close"}


@dataclass(frozen=True)
class TimedAnswer:
    """One answer: seconds to its first and last token, tokens from the prefix cache, newly read and written.

    ``cpu_s`` are this whole process's processor seconds, which a busy machine changes least. ``late``: the call was
    given up at the limit, and the seconds are the limit.
    """

    seconds: float
    first_s: float
    cpu_s: float = 0.0
    text: str = ""
    cached: int = 0
    new: int = 0
    written: int = 0
    late: bool = False


class LocalLLM:
    """The embedded model, loaded as the edge loads it.

    Args:
        threads: of llama.cpp.
        context: tokens of a slot.
        slots: concurrent requests.
    """

    def __init__(self, threads: int, context: int, slots: int = 1) -> None:
        began = time.perf_counter()
        gguf = embedded_model(Settings())
        self._server = EmbeddedServer(gguf, threads=threads, context=context * slots, slots=slots)
        self.load_s = time.perf_counter() - began
        self.name = self._server.model
        key = {"Authorization": f"Bearer {self._server.api_key}"}
        base = self._server.base_url.removesuffix("/v1")
        self._http = httpx.Client(base_url=base, headers=key, timeout=LIMIT_S, trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()
        self._server.close()

    def tokens(self, prompt: Prompt) -> list[int]:
        """A prompt as the model reads it, its chat template around it."""
        messages = [{"role": "system", "content": prompt.static}, {"role": "user", "content": prompt.user}]
        text = self._post("/apply-template", {"messages": messages})["prompt"]
        body = {"content": text, "add_special": True, "parse_special": True}
        return [int(token) for token in self._post("/tokenize", body)["tokens"]]

    def ask(self, body: dict[str, Any], limit_s: float = LIMIT_S, **changes: Any) -> TimedAnswer:
        """One chat completion; ``changes`` are further fields of the request."""
        request = {**body, **changes, "stream": True, "stream_options": {"include_usage": True}}
        began, cpu = time.perf_counter(), time.process_time()
        first_s, text, timings = 0.0, "", dict[str, Any]()
        try:
            with self._http.stream(
                "POST", "/v1/chat/completions", json=request, timeout=limit_s, headers=_CLOSE
            ) as response:
                if response.status_code != 200:
                    raise SystemExit(f"the embedded LLM refused a request: {response.read().decode()[:200]}")
                for line in response.iter_lines():
                    if time.perf_counter() - began > limit_s:
                        return TimedAnswer(limit_s, first_s or limit_s, time.process_time() - cpu, text, late=True)
                    if not line.startswith("data: {"):
                        continue
                    chunk = json.loads(line.removeprefix("data: "))
                    timings = chunk.get("timings") or timings
                    for choice in chunk["choices"]:
                        text += (content := choice["delta"].get("content") or "")
                        first_s = first_s or (time.perf_counter() - began if content else 0.0)
        except httpx.TimeoutException:
            return TimedAnswer(limit_s, first_s or limit_s, time.process_time() - cpu, text, late=True)
        seconds = time.perf_counter() - began
        cached, new, written = (int(timings[name]) for name in ("cache_n", "prompt_n", "predicted_n"))
        return TimedAnswer(seconds, first_s or seconds, time.process_time() - cpu, text, cached, new, written)

    def _post(self, path: str, body: dict[str, Any]) -> Any:
        return self._http.post(path, json=body).raise_for_status().json()
