"""The embedded LLM: llama.cpp in this process, with the HTTP interface of any other server, on loopback."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import xllamacpp

from service.config.settings import Settings
from service.llm.adapter_version import check_adapter
from service.llm.model_file import embedded_model

# By default llama.cpp uses up to 8 GB of host memory for old prompts.
_PROMPT_CACHE_MIB = 64
_ONLY_ERRORS = 1
_BATCH = 128


class LoadFailed(RuntimeError):
    """llama.cpp cannot load the model file."""


class EmbeddedServer:
    """A loaded model behind a loopback address. The constructor blocks for seconds: call it in a thread.

    The server requires a random key, so that other users of the machine cannot spend its time.

    Args:
        adapter: a LoRA adapter that is applied to every request without :attr:`without_adapter`. The model's name then
            ends in ``+`` and the adapter's.
        context: tokens, which the slots share evenly.
        slots: requests served at once, each with its own prefix cache. With one slot, the static block and the
            experiences are one prefix for the whole fleet.

    Attributes:
        without_adapter: the fields that a request needs to be answered by the bare model.

    Raises:
        LoadFailed: llama.cpp could not load the file.
    """

    def __init__(self, gguf: Path, *, threads: int, context: int, slots: int = 1, adapter: Path | None = None) -> None:
        params = xllamacpp.CommonParams()
        params.model.path = str(gguf)
        params.cpuparams.n_threads = threads
        params.cpuparams_batch.n_threads = threads
        params.n_ctx = context
        params.n_parallel = slots
        # llama.cpp notices a cancelled call between batches: the next decision would wait seconds for a large one.
        params.n_batch = params.n_ubatch = _BATCH
        # llama.cpp's cache of old prompts ignores adapters: what was read with one would serve a request without it.
        params.cache_ram_mib = _PROMPT_CACHE_MIB if adapter is None else 0
        params.verbosity = _ONLY_ERRORS
        params.ui = False
        if adapter is not None:
            params.lora_adapters = [xllamacpp.CommonAdapterLoraInfo(str(adapter), 1.0)]
        self.without_adapter: dict[str, Any] = {} if adapter is None else {"lora": [{"id": 0, "scale": 0.0}]}
        # Requests without the adapter, and how many of them had begun when the adapter last read a whole prompt.
        self._bare_requests = self._read_again_after = 0
        self.api_key = secrets.token_urlsafe(24)
        params.api_keys = [self.api_key]
        try:
            self._server: xllamacpp.Server | None = xllamacpp.Server(params)
        except RuntimeError as error:
            files = gguf.name if adapter is None else f"{gguf.name} with {adapter.name}"
            raise LoadFailed(f"llama.cpp cannot load {files}: {error}") from error
        self.base_url = f"{self._server.listening_address}/v1"
        self.bare_model = gguf.stem
        self.model = gguf.stem if adapter is None else f"{gguf.stem}+{adapter.stem}"

    @property
    def gone(self) -> bool:
        """Whether the server is at this address no longer: False."""
        return False

    @contextmanager
    def request(self, system: str, trained: str) -> Iterator[dict[str, Any]]:
        """While a request runs, its fields: the adapter answers prompts whose static block ends as ``trained``."""
        if not self.without_adapter:
            yield {}
            return
        if not system.endswith(trained):
            self._bare_requests += 1
            yield self.without_adapter
            return
        # llama.cpp would reuse what the bare model has read of the chat's first tokens.
        bare = self._bare_requests
        yield {} if bare == self._read_again_after else {"cache_prompt": False}
        self._read_again_after = bare

    def close(self) -> None:
        """Stop the server and free the model; blocks until its threads have ended."""
        self._server = None


def embed(settings: Settings) -> EmbeddedServer:
    """Load the model and the adapter that the settings name; it takes seconds.

    Raises:
        ModelMissing, AdapterUnusable, LoadFailed: there is none, or it cannot be used.
    """
    gguf, adapter = embedded_model(settings), settings.embedded_adapter
    if adapter is not None:
        check_adapter(adapter)
    return EmbeddedServer(gguf, threads=settings.embedded_threads, context=settings.llm_context, adapter=adapter)


async def embedded(settings: Settings) -> EmbeddedServer:
    """As :func:`embed`, in a thread."""
    return await asyncio.to_thread(embed, settings)


# Gets an embedded LLM; raises as `embed`.
Embed = Callable[[Settings], Awaitable[EmbeddedServer]]
