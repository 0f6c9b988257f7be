"""The edges that an experiment flies against: started as needed, one at a time, with nothing inherited by chance."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import httpx
from rich.console import Console

from shared.scenario import Scenario
from simulator.client import EdgeClient
from simulator.client.lossy_transport import LossyTransport
from simulator.errors import EdgeError
from simulator.experiments.schemes import ASKED, CHANCE, OFF, WORST, Backing
from simulator.experiments.stand_ins import answering, drawn, worst
from simulator.flying.local_edge import HOST, check_alive, edge_process, usable_port
from simulator.flying.run import API_KEY

# Settings that say how to reach the LLM or what this machine can bear. Every other one changes what is decided, and
# a figure must not depend on what happens to be exported.
_INHERITED = {"AICVDS_LLM_THREADS", "AICVDS_LLM_CONTEXT", "AICVDS_CACHE_DIR"}
_MODEL = "AICVDS_LLM_MODEL"
_OF_A_SERVER = {_MODEL, "AICVDS_LLM_API_KEY"}
_WAIT_S = 300.0
_TIMEOUT_SLACK_S = 5.0
_DEFAULT_TIMEOUT_S = 65.0


@dataclass(frozen=True)
class Llm:
    """What ``--llm``, ``--model`` and ``--edge`` say: where the LLM of the schemes that ask one is."""

    asked: str = "embedded"
    edge: str | None = None

    @property
    def embedded(self) -> bool:
        """Whether it is the embedded one, on an edge started here."""
        return self.asked == "embedded" and self.edge is None

    @property
    def there(self) -> bool:
        """Whether schemes that ask what ``--llm`` names can fly."""
        return self.asked != "none" or self.edge is not None

    def identity(self, backing: Backing) -> str:
        """What a flight's key says of the LLM: two of one identity answer alike."""
        if backing in (OFF, CHANCE, WORST):
            return backing
        if backing == ASKED:
            if self.edge is not None:
                return f"edge {self.edge}"
            return self.asked if self.embedded else f"{self.asked} {os.environ.get(_MODEL, '')}".strip()
        return f"{Path(backing).stem} {_sha256(Path(backing))[:16]}"


@dataclass(frozen=True)
class EdgeAt:
    """An edge that is ready. ``alive`` raises :class:`EdgeError` with its log's end once its process has ended."""

    url: str
    model: str | None
    alive: Callable[[], None]


@contextmanager
def edge_for(backing: Backing, llm: Llm, log: Path, console: Console) -> Iterator[EdgeAt]:
    """The edge that has what ``backing`` names behind it, started here and stopped on leaving; or ``--edge``'s.

    Raises:
        EdgeError: it died, is not ready in time, or has no LLM ready though it should have one.
    """
    if backing == ASKED and llm.edge is not None:
        with _ready(llm.edge, lambda: None, console) as (readiness_model, llm_state):
            _refuse_without_llm(backing, llm_state)
            yield EdgeAt(llm.edge, readiness_model, lambda: None)
        return
    with ExitStack() as stack:
        port = usable_port(0)
        process = stack.enter_context(edge_process(port, log, stack.enter_context(environment_for(backing, llm))))
        url = f"http://{HOST}:{port}"

        def alive() -> None:
            check_alive(process, log)

        with _ready(url, alive, console) as (model, state):
            _refuse_without_llm(backing, state)
            yield EdgeAt(url, None if backing == OFF else model, alive)


@contextmanager
def environment_for(backing: Backing, llm: Llm) -> Iterator[Mapping[str, str]]:
    """The settings of an edge with that behind it, and of this process's only what cannot change a decision."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("AICVDS_") or k in _INHERITED}
    # A mission a flight, and a full run has thousands of flights, none of which is gone back to.
    kept |= {"AICVDS_MAX_MISSIONS": "1000000", "AICVDS_LOG_LEVEL": "warning", "AICVDS_STORE": "none"}
    # Mode llm as the paper writes it, unless a scheme says otherwise.
    kept["AICVDS_VERIFY"] = "off"
    if backing == OFF:
        yield kept | {"AICVDS_MODE": "value"}
    elif backing in (CHANCE, WORST):
        with answering(drawn if backing == CHANCE else worst) as url:
            yield kept | {"AICVDS_LLM_URL": url}
    elif backing != ASKED:
        yield kept | {"AICVDS_LLM_GGUF": str(Path(backing).resolve())}
    elif llm.embedded:
        yield kept
    else:
        of_a_server = {name: os.environ[name] for name in _OF_A_SERVER & os.environ.keys()}
        yield kept | of_a_server | {"AICVDS_LLM_URL": llm.asked}


@contextmanager
def _ready(url: str, alive: Callable[[], None], console: Console) -> Iterator[tuple[str | None, str]]:
    with EdgeClient(url, timeout_s=_TIMEOUT_SLACK_S, api_key=os.environ.get(API_KEY)) as client:
        readiness = client.wait_ready(_WAIT_S, on_wait=lambda _: alive())
    alive()
    if readiness.llm == "unavailable" and readiness.detail:
        console.print(f"LLM: {readiness.detail}", markup=False, highlight=False)
    yield readiness.model, readiness.llm


def _refuse_without_llm(backing: Backing, state: str) -> None:
    if backing != OFF and state != "ready":
        raise EdgeError(
            f"no LLM is ready (it is {state}), and decisions of the policy in its place would not be its decisions; "
            "run `aicvds model fetch`, name a server with --llm URL, or leave its schemes out with --llm none"
        )


def radio(url: str, deadline_ms: int | None, scenario: Scenario, seed: int) -> EdgeClient:
    """The fleet's way to the edge, which loses requests where the scenario says so."""
    transport = None
    if scenario.uplink_drop or scenario.uplink_jitter_ms:
        inner = httpx.HTTPTransport()
        transport = LossyTransport(inner, drop=scenario.uplink_drop, jitter_ms=scenario.uplink_jitter_ms, seed=seed)
    timeout_s = _DEFAULT_TIMEOUT_S if deadline_ms is None else deadline_ms / 1e3 + _TIMEOUT_SLACK_S
    return EdgeClient(url, timeout_s=timeout_s, api_key=os.environ.get(API_KEY), seed=seed, transport=transport)


@cache
def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
