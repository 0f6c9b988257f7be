"""A llama.cpp server in a process of its own: ``python -m tests.support.llama_server PORT NAME GGUF SLOTS [ADAPTER]``.

It equals ``llama-server --port PORT --alias NAME --model GGUF --parallel SLOTS --lora ADAPTER`` with one thread, from
the package that the edge embeds.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# The tokens of each slot.
_CONTEXT = 4096


def serve(port: int, name: str, gguf: str, slots: int, adapter: str | None = None) -> None:
    """Serve until the process is killed."""
    import xllamacpp

    params = xllamacpp.CommonParams()
    params.model.path = gguf
    params.model_alias = {name}
    params.port = port
    params.n_parallel, params.n_ctx = slots, slots * _CONTEXT
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = 1
    if adapter is not None:
        params.lora_adapters = [xllamacpp.CommonAdapterLoraInfo(adapter, 1.0)]
    # A prompt that no slot has is read again.
    params.cache_ram_mib = 0
    params.verbosity = 1
    server = xllamacpp.Server(params)
    assert server.listening_address.endswith(f":{port}")
    signal.pause()


@contextmanager
def running(
    port: int, name: str, gguf: str, slots: int, adapter: str | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """The server as a process, which may still load; killed at the end."""
    command = [sys.executable, "-m", "tests.support.llama_server", str(port), name, gguf, str(slots)]
    process = subprocess.Popen(command if adapter is None else [*command, adapter])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


if __name__ == "__main__":
    serve(int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]), *sys.argv[5:])
