"""The embedded LLM: llama.cpp in this process, with the HTTP interface of any other server, on loopback."""

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.config.settings import Settings
from service.llm.adapter_version import DECISIONS, ORDERS, check_adapter
from service.llm.model_file import embedded_model
from shared.kit.memory import release_zeros

# By default llama.cpp uses up to 8 GB of host memory for old prompts.
_PROMPT_CACHE_MIB = 64
_ONLY_ERRORS = 1
_BATCH = 128
# The least memory for states that is worth giving back, bytes.
_STATES = 2**25


class LoadFailed(RuntimeError):
    """llama.cpp cannot be loaded, or cannot load the model file."""


class EmbeddedServer:
    """A loaded model behind a loopback address. The constructor blocks for seconds: call it in a thread.

    The server requires a random key, so that other users of the machine cannot spend its time.

    Args:
        adapter: a LoRA adapter that is applied to every request without :attr:`without_adapter`. The model's name then
            ends in ``+`` and the adapter's.
        orders: a LoRA adapter that is applied only to requests for notes.
        context: tokens, which the slots share evenly.
        slots: requests served concurrently, each with its own prefix cache. With one slot, the static block and the
            experiences are one prefix for the whole fleet.

    Attributes:
        without_adapter: the fields that a request needs to be answered by the bare model.
        with_orders: the fields that a request needs to be answered with the orders' adapter; empty without one.
        bare_model, model, notes_model: names of the model without an adapter, with the decisions' and with the orders'.

    Raises:
        LoadFailed: llama.cpp could not be loaded, or could not load the file.
    """

    def __init__(
        self,
        gguf: Path,
        *,
        threads: int,
        context: int,
        slots: int = 1,
        adapter: Path | None = None,
        orders: Path | None = None,
    ) -> None:
        try:
            # Here, because an edge with an LLM server has no use for it.
            import xllamacpp
        except ImportError as error:
            raise LoadFailed(f"llama.cpp cannot be loaded: {error}; Debian has libgomp.so.1 in libgomp1") from error
        params = xllamacpp.CommonParams()
        params.model.path = str(gguf)
        params.cpuparams.n_threads = threads
        params.cpuparams_batch.n_threads = threads
        params.n_ctx = context
        params.n_parallel = slots
        # llama.cpp notices a cancelled call between batches: the next decision would wait seconds for a large one.
        params.n_batch = params.n_ubatch = _BATCH
        # llama.cpp's cache of old prompts ignores adapters: states computed with one would serve a request without it.
        params.cache_ram_mib = _PROMPT_CACHE_MIB if adapter is None and orders is None else 0
        params.verbosity = _ONLY_ERRORS
        params.ui = False
        # The scales of requests that name none.
        loaded = {path: scale for path, scale in ((adapter, 1.0), (orders, 0.0)) if path is not None}
        params.lora_adapters = [xllamacpp.CommonAdapterLoraInfo(str(path), scale) for path, scale in loaded.items()]
        self.without_adapter = _scales(loaded, None)
        # States computed with another adapter are not reused.
        self.with_orders = {} if orders is None else {**_scales(loaded, orders), "cache_prompt": False}
        # Requests without the adapter, and their number when the adapter last read a whole prompt.
        self._bare_requests = self._read_again_after = 0
        self.api_key = secrets.token_urlsafe(24)
        params.api_keys = [self.api_key]
        try:
            self._server: Any = xllamacpp.Server(params)
        except RuntimeError as error:
            files = " with ".join([gguf.name, *(path.name for path in loaded)])
            raise LoadFailed(f"llama.cpp cannot load {files}: {error}") from error
        # It has written zeros to the states of a whole context, and no request can come yet.
        release_zeros(_STATES)
        self.base_url = f"{self._server.listening_address}/v1"
        self.bare_model = gguf.stem
        self.model, self.notes_model = (
            gguf.stem if one is None else f"{gguf.stem}+{one.stem}" for one in (adapter, orders)
        )

    @contextmanager
    def request(self, system: str, trained: str) -> Iterator[dict[str, Any]]:
        """The fields of a request while it runs: the adapter answers prompts whose static block is ``trained``."""
        if not self.without_adapter:
            yield {}
            return
        if system != trained:
            self._bare_requests += 1
            yield self.without_adapter
            return
        # llama.cpp would reuse the bare model's states of the chat's first tokens.
        bare = self._bare_requests
        yield {} if bare == self._read_again_after else {"cache_prompt": False}
        self._read_again_after = bare

    @contextmanager
    def note_request(self) -> Iterator[dict[str, Any]]:
        """The fields of a request about a note while it runs: for the orders' adapter, or else for the bare model."""
        # The prompt cache treats it as a request to the bare model.
        with self.request("", "not a decision's") as bare:
            yield self.with_orders or bare

    def close(self) -> None:
        """Stop the server and free the model; blocks until its threads have ended."""
        self._server = None


def embed(settings: Settings) -> EmbeddedServer:
    """Load the model and the adapter that the settings name; it takes seconds.

    Raises:
        ModelMissing, AdapterUnusable, LoadFailed: there is none, or it cannot be used.
    """
    gguf, adapter, orders = embedded_model(settings), settings.embedded_adapter, settings.embedded_orders
    for path, version in ((adapter, DECISIONS), (orders, ORDERS)):
        if path is not None:
            check_adapter(path, version)
    threads, context = settings.embedded_threads, settings.llm_context
    return EmbeddedServer(gguf, threads=threads, context=context, adapter=adapter, orders=orders)


def _scales(loaded: Collection[Path], applied: Path | None) -> dict[str, Any]:
    """The field with the scale of each loaded adapter. llama.cpp takes an empty list for a missing one."""
    scales = [{"id": number, "scale": float(path == applied)} for number, path in enumerate(loaded)]
    return {"lora": scales} if scales else {}


async def embedded(settings: Settings) -> EmbeddedServer:
    """As :func:`embed`, in a thread."""
    return await asyncio.to_thread(embed, settings)


# Gets an embedded LLM; raises as `embed`.
Embed = Callable[[Settings], Awaitable[EmbeddedServer]]
