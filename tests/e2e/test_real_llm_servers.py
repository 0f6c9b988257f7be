"""Missions by LLM servers that people run: each of their decisions is the LLM's, and the doctor names each ability."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import trustme

from service.config.settings import SHIPPED_ADAPTER, Settings
from service.llm.model_file import embedded_model
from service.llm.server_pool import weight
from tests.integration.service.llm.test_server_pool import standing_by
from tests.support.edge_stub import free_port
from tests.support.llama_server import running
from tests.support.processes import run_here
from tests.support.real_llm_servers import (
    MASTER_KEY,
    Packages,
    forward_proxy,
    litellm,
    tls_front,
    transformers_serve,
    vllm,
    wait_for_server,
)
from tests.support.stub_llm import wait_for
from tests.support.waiting import until

Edge = Callable[..., httpx.Client]

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

# The model's adapter is served, so that its short prompts and single letters need little time of two cores.
SERVED = {"llm_adapter": "served"}
# In this world every UAV hears a free sensor at every step, so that there is always something to ask.
FLIGHT = ("--steps", "4", "--seed", "1", "--no-bound", "--deadline-ms", "60000")
DECISIONS = 12


@dataclass(frozen=True)
class Way:
    """A server, how to reach it, and what the doctor says of it.

    Attributes:
        settings: of the edge.
        environment: variables as the edge starts.
        said: of the server's abilities.
        passed: a log, and what it has if the doctor's requests went this way.
    """

    settings: dict[str, Any]
    said: str
    environment: dict[str, str]
    passed: tuple[Path, str] | None = None


@dataclass(frozen=True)
class Servers:
    """The servers that the tests share."""

    ways: dict[str, Way]
    families: dict[str, str]


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    """All servers, started side by side; the longest part is to write the model for ``transformers serve``."""
    folder = tmp_path_factory.mktemp("servers")
    gguf, model, ports = str(embedded_model(Settings())), folder / "model", [free_port() for _ in range(3)]
    served, small, gemma = (f"http://127.0.0.1:{port}/v1" for port in ports)
    authority = trustme.CA()
    authority.cert_pem.write_to_path(folder / "authority.pem")
    issued = authority.issue_cert("127.0.0.1", "localhost")
    issued.private_key_and_cert_chain_pem.write_to_path(folder / "server.pem")
    with ExitStack() as stack:
        writing = subprocess.Popen([sys.executable, "-m", "tests.support.hugging_face_model", str(model)])
        stack.callback(writing.kill)
        packages = Packages(folder)
        stack.enter_context(running(ports[0], "small", gguf, 1, str(SHIPPED_ADAPTER)))
        routed = stack.enter_context(litellm(packages, served, folder))
        secure = stack.enter_context(tls_front(ports[0], folder / "server.pem", folder))
        proxy = stack.enter_context(forward_proxy(packages, folder / "proxy.log"))
        stack.enter_context(running(ports[1], "smollm2", gguf, 1))
        stack.enter_context(running(ports[2], "gemma", str(packages.gemma(folder / "gemma.gguf")), 1))
        assert writing.wait() == 0
        adapted = stack.enter_context(vllm(packages, model / "bare", model / "adapter", folder))
        transformers = stack.enter_context(transformers_serve(packages, model / "merged", folder))
        for url in (served, small, gemma):
            wait_for_server(url.replace("/v1", "/health"))
        wait_for_server(routed.replace("/v1", "/health/liveliness"), folder / "litellm.log")
        wait_for_server(transformers.replace("/v1", "/health"), folder / "transformers.log")
        wait_for_server(adapted.replace("/v1", "/health"), folder / "vllm.log")
        trusted = {"SSL_CERT_FILE": str(folder / "authority.pem")}
        # The edge and the simulator talk to each other without the proxy.
        proxies = {"HTTP_PROXY": proxy, "HTTPS_PROXY": proxy, "NO_PROXY": "127.0.0.1"}
        best = "constrained by grammar, token probabilities after sampling, several UAVs a call"
        likeliest = "constrained by grammar, the 20 likeliest tokens, several UAVs a call"
        labels = "constrained by structured_outputs, the 20 likeliest tokens, several UAVs a call"
        plain = "answers as text that the edge checks, no token probabilities, one UAV a call"
        log, there, tunnel = folder / "proxy.log", served.replace("127.0.0.1", "localhost"), secure.split("/")[2]
        tunnel = tunnel.replace("127.0.0.1", "localhost")
        yield Servers(
            {
                "llama.cpp": Way({"llm_url": served}, best, {}),
                "LiteLLM": Way({"llm_url": routed, "llm_api_key": MASTER_KEY}, likeliest, {}),
                "transformers serve": Way({"llm_url": transformers}, plain, {}),
                "vLLM": Way({"llm_url": adapted, "llm_model": "decider"}, labels, {}),
                "TLS": Way({"llm_url": secure}, best, trusted),
                "proxy": Way({"llm_url": there}, best, proxies, (log, f"GET localhost:{ports[0]}/v1/models")),
                "tunnel": Way(
                    {"llm_url": f"https://{tunnel}/v1"}, best, {**trusted, **proxies}, (log, f"CONNECT {tunnel}")
                ),
            },
            {"smollm2": small, "gemma": gemma},
        )


def fly(client: httpx.Client, out: Path, *options: str) -> dict[str, Any]:
    """Fly four steps of the paper's world; the summary."""
    flown = run_here("simulate", "--edge", str(client.base_url), *FLIGHT, "--out", str(out), *options)
    assert flown.returncode == 0, flown.stderr
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


WAYS = ["llama.cpp", "LiteLLM", "transformers serve", "vLLM", "TLS", "proxy", "tunnel"]


@pytest.mark.parametrize("mode", ["llm", "guided"])
@pytest.mark.parametrize("name", WAYS)
def test_the_llm_makes_every_decision_of_a_mission(
    name: str, mode: str, servers: Servers, edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    way = servers.ways[name]
    with monkeypatch.context() as patch:
        for variable, value in way.environment.items():
            patch.setenv(variable, value)
        client = edge(mode=mode, **SERVED, **way.settings)
        wait_for(client, "ready")
    summary = fly(client, tmp_path / "out")
    assert (summary["decisions"], summary["late"]) == (DECISIONS, 0), summary
    assert summary["by_source"][mode] == DECISIONS, summary


@pytest.mark.parametrize("name", WAYS)
def test_the_doctor_says_what_a_server_can_do(name: str, servers: Servers, tmp_path: Path) -> None:
    way = servers.ways[name]
    settings = {f"AICVDS_{key.upper()}": value for key, value in {**SERVED, **way.settings}.items()}
    examined = run_here(
        "doctor",
        *("--port", str(free_port()), "--llm-url", settings.pop("AICVDS_LLM_URL")),
        **{"AICVDS_MODE": "llm", "AICVDS_DEADLINE_MS": "60000", **settings, **way.environment},
    )
    assert way.said in examined.stdout
    assert "a decision took " in examined.stdout
    assert examined.returncode == 0, examined.stdout
    if way.passed is not None:
        # The proxy writes a connection's first request when the connection ends.
        log, line = way.passed
        until(lambda: line in log.read_text())


@pytest.mark.parametrize("mode", ["llm", "guided"])
def test_two_families_of_models_decide_for_one_edge(mode: str, servers: Servers, edge: Edge, tmp_path: Path) -> None:
    # With the bare models' prompt, and without the rules that override them: as in the paper their answer is flown.
    urls = servers.families
    client = edge(mode=mode, llm_url=",".join(urls.values()), llm_order="mission", verify="off")
    standing_by(client, 1)
    for name in urls:
        mission = next(m for m in map(str, range(100)) if max(urls, key=lambda own: weight(m, urls[own])) == name)
        summary = fly(client, tmp_path / name, "--mission", mission)
        # A UAV that hears no free sensor asks nothing.
        asked = DECISIONS - summary["by_reason"].get("no_candidate", 0)
        assert (summary["by_source"][mode], summary["model"]) == (asked, name), summary["by_reason"]
        assert asked >= DECISIONS / 2
