"""The edges of an experiment: started as needed, one at a time, with a controlled environment."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import httpx
from rich.console import Console

from lab.experiments.schemes import ADAPTED, CHANCE_AS_ADAPTED, NAMED_BY_OPTION, OFF, STAND_INS, WORST, Backing
from lab.experiments.stand_ins import answering, drawn, worst
from shared.client.edge_client import API_KEY, EdgeClient
from shared.client.errors import EdgeError
from shared.world.scenario import Scenario
from simulator.flying.edge_session import LossyTransport
from simulator.flying.local_edge import HOST, check_alive, edge_process, usable_port

# Settings for the machine's capacity and paths. Every other setting may change decisions, and a figure must not depend
# on the user's environment.
_INHERITED = {"AICVDS_LLM_THREADS", "AICVDS_LLM_CONTEXT", "AICVDS_CACHE_DIR"}
_MODEL, _ADAPTER = "AICVDS_LLM_MODEL", "AICVDS_LLM_ADAPTER"
_OF_A_SERVER = {_MODEL, "AICVDS_LLM_API_KEY"}
_WAIT_S = 300.0
_TIMEOUT_SLACK_S = 5.0
_DEFAULT_TIMEOUT_S = 65.0


@dataclass(frozen=True)
class Llm:
    """The LLM of the schemes that query one: ``option`` is ``--llm``, ``edge`` is ``--edge``."""

    option: str = "embedded"
    edge: str | None = None

    @property
    def embedded(self) -> bool:
        """Whether it is the embedded LLM of an edge started here."""
        return self.option == "embedded" and self.edge is None

    @property
    def available(self) -> bool:
        """Whether schemes with the LLM of ``--llm`` can fly."""
        return self.option != "none" or self.edge is not None

    def flies(self, backing: Backing) -> bool:
        """Whether schemes with that backing can fly."""
        if backing == ADAPTED:
            return self.option != "none" and _adapter().is_file()
        return self.available if backing == NAMED_BY_OPTION else True

    def identity(self, backing: Backing) -> str:
        """The identity of an edge's decider in a flight's key: the LLM, and the initial weights of the modules."""
        return f"{self._llm_of(backing)} {_modules()}"

    def _llm_of(self, backing: Backing) -> str:
        """The identity of the LLM; LLMs of the same name give the same answers."""
        if backing in (OFF, *STAND_INS):
            return backing
        if backing == NAMED_BY_OPTION:
            if self.edge is not None:
                return f"edge {self.edge}"
            return self.option if self.embedded else f"{self.option} {os.environ.get(_MODEL, '')}".strip()
        if backing == ADAPTED:
            return f"adapted {_sha256(_adapter())[:16]}"
        return f"{Path(backing).stem} {_sha256(Path(backing))[:16]}"


@dataclass(frozen=True)
class EdgeAt:
    """An edge that is ready. ``alive`` raises :class:`EdgeError` with the log's end if the edge's process has ended."""

    url: str
    model: str | None
    alive: Callable[[], None]


@contextmanager
def edge_for(backing: Backing, llm: Llm, log: Path, console: Console) -> Iterator[EdgeAt]:
    """Within the context, run an edge with that backing, or use the edge of ``--edge``.

    Raises:
        EdgeError: the edge died, is not ready in time, or lacks a ready LLM that it needs.
    """
    if backing == NAMED_BY_OPTION and llm.edge is not None:
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
    """The environment of an edge with that backing; it inherits only settings that cannot change a decision."""
    base = {k: v for k, v in os.environ.items() if not k.startswith("AICVDS_") or k in _INHERITED}
    # A full run has thousands of flights with a mission each, and never returns to one.
    base |= {"AICVDS_MAX_MISSIONS": "1000000", "AICVDS_LOG_LEVEL": "warning", "AICVDS_STORE": "none"}
    # Mode llm as in the paper, unless a scheme overrides it.
    base["AICVDS_VERIFY"] = "off"
    # The embedded LLM as it is, unless a scheme names its adapter.
    base[_ADAPTER] = "off"
    if backing == OFF:
        yield base | {"AICVDS_MODE": "value"}
    elif backing in STAND_INS:
        with answering(worst if backing == WORST else drawn) as url:
            adapter = {_ADAPTER: "served"} if backing == CHANCE_AS_ADAPTED else {}
            yield base | adapter | {"AICVDS_LLM_URL": url}
    elif backing == ADAPTED:
        yield base | {_ADAPTER: str(_adapter())}
    elif backing != NAMED_BY_OPTION:
        yield base | {"AICVDS_LLM_GGUF": str(Path(backing).resolve())}
    elif llm.embedded:
        yield base
    else:
        of_a_server = {name: os.environ[name] for name in _OF_A_SERVER & os.environ.keys()}
        yield base | of_a_server | {"AICVDS_LLM_URL": llm.option}


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
    """The client of the fleet's radio link to the edge, lossy if the scenario's uplink is."""
    transport = None
    if scenario.uplink_drop or scenario.uplink_jitter_ms:
        inner = httpx.HTTPTransport()
        transport = LossyTransport(inner, drop=scenario.uplink_drop, jitter_ms=scenario.uplink_jitter_ms, seed=seed)
    timeout_s = _DEFAULT_TIMEOUT_S if deadline_ms is None else deadline_ms / 1e3 + _TIMEOUT_SLACK_S
    return EdgeClient(url, timeout_s=timeout_s, api_key=os.environ.get(API_KEY), seed=seed, transport=transport)


def _adapter() -> Path:
    """The path of the adapter's file, which may not exist."""
    named = os.environ.get(_ADAPTER)
    return Path(named).resolve() if named else _checkpoints() / "adapter.gguf"


def _checkpoints() -> Path:
    """The folder of the weights that ship."""
    service = find_spec("service")
    return Path((service and service.origin) or "").parent / "checkpoints"


@cache
def _modules() -> str:
    """The hash of the weights that ship for attention and velocities, so that an edge with new ones flies again."""
    return hashlib.sha256("".join(map(_sha256, sorted(_checkpoints().glob("*.npz")))).encode()).hexdigest()[:16]


@cache
def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
