"""``aicvds doctor``: problems that may keep an edge from running here, and their remedies."""

import asyncio
import os
import platform
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import ValidationError

from service.commands.serve import fault_of_keys
from service.config.settings import Settings, unknown_variables
from shared.kit.validation_messages import problem_of
from shared.wire.schemas import LLM_MODES

if TYPE_CHECKING:
    from service.llm.probing import Examination

_LATE = (
    "raise AICVDS_DEADLINE_MS, use a faster model, or turn its thoughts off "
    """(AICVDS_LLM_EXTRA_BODY='{"reasoning_effort": "none"}')"""
)
_REMEDIES = {
    "llm_status": "the server refuses: check AICVDS_LLM_URL (most end in /v1), AICVDS_LLM_MODEL and AICVDS_LLM_API_KEY",
    "llm_error": "start the server, or correct AICVDS_LLM_URL (most end in /v1)",
    "answer_format": "the model answers in another form: try another model, or raise AICVDS_LLM_THINKING_TOKENS",
    "answer_sensor": "the model names a sensor that was not offered: try another model",
    "answer_velocity": "the model names a velocity that does not exist: try another model",
}
_SUPPORTED = ((3, 11), (3, 13))


@dataclass(frozen=True)
class Doctor:
    """Check this machine for an edge: versions, settings, port, store, LLM, planner.

    Each line has one finding. A line with !! says what to type. Nothing is changed. The settings are those that
    `aicvds serve` would have: the variables AICVDS_*.

    An LLM server is asked as the edge asks it: the findings are its abilities, and the time of one decision.

    Try it:  aicvds doctor
             aicvds doctor --llm-url http://localhost:11434/v1

    Exit code: 0 nothing is in the way, 1 something is.
    """

    host: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """Address that the edge is to listen on. Default: AICVDS_HOST, or 127.0.0.1."""
    port: Annotated[int | None, tyro.conf.arg(metavar="1-65535", help_behavior_hint="")] = None
    """Port that the edge is to listen on. Default: AICVDS_PORT, or 8000."""
    llm_url: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    """Address of an LLM server, as AICVDS_LLM_URL, to be judged before a flight."""


@dataclass(frozen=True)
class Finding:
    """One finding: its subject, the result, and the remedy of a problem."""

    what: str
    found: str
    remedy: str | None = None

    def __str__(self) -> str:
        mark = "ok" if self.remedy is None else "!!"
        return f"{mark}  {self.what:<9} {self.found}" + (f"\n              {self.remedy}" if self.remedy else "")


def main(argv: list[str]) -> int:
    """Run ``aicvds doctor``; returns the exit code."""
    options = tyro.cli(Doctor, prog="aicvds doctor", args=argv)
    if options.port is not None and not 1 <= options.port <= 65535:
        print(f"aicvds doctor: --port {options.port} is not between 1 and 65535", file=sys.stderr)
        return 2
    given = {name: value for name, value in vars(options).items() if value is not None}
    trouble = 0
    for finding in findings(given):
        print(finding, flush=True)
        trouble += finding.remedy is not None
    print(f"{trouble} in the way" if trouble else "Nothing is in the way. Next:  aicvds serve")
    return 1 if trouble else 0


def findings(given: dict[str, Any]) -> Iterator[Finding]:
    """All findings, in the order in which a start would meet them; ``given`` settings replace the environment's."""
    yield versions()
    for name, meant in unknown_variables().items():
        yield Finding("settings", f"{name} is no setting and changes nothing{meant}", f"unset {name}")
    try:
        settings = Settings(**given)
    except ValidationError as error:
        for fault in error.errors():
            name = "AICVDS_" + "_".join(str(part) for part in fault["loc"]).upper()
            found = f"{name.removesuffix('_')}: {problem_of(fault)}"
            yield Finding("settings", found, "see docs/reference/settings.md")
        return
    yield port_of(settings.host, settings.port)
    if (refusal := fault_of_keys(settings, settings.host)) is not None:
        yield Finding("keys", refusal, "aicvds keys add NAME --file FILE, and AICVDS_KEYS=FILE")
    yield Finding("settings", f"mode {settings.mode}, deadline {settings.deadline_ms} ms, top-k {settings.top_k}")
    yield store_of(settings)
    if settings.mode in LLM_MODES or "llm_url" in given:
        yield from (llm_servers(settings) if settings.llm_url else embedded(settings))
    yield planner(settings)


def versions() -> Finding:
    """The versions of Python and of this package."""
    found = f"aicvds {version('aic-vds')}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    least, most = _SUPPORTED
    if not least <= sys.version_info[:2] <= most:
        return Finding("versions", found, "use Python 3.11, 3.12 or 3.13")
    return Finding("versions", found)


def port_of(host: str, port: int) -> Finding:
    """Whether the port is free."""
    try:
        with socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            return Finding("port", f"{host}:{port} is free")
    except OSError as error:
        fault = error.strerror or str(error)
    return Finding("port", f"{host}:{port}: {fault}", "aicvds serve --port 0, or use the edge that may run there")


def store_of(settings: Settings) -> Finding:
    """Whether the store can be used: a SQLite file's lock, or that PostgreSQL's driver is there."""
    if settings.store == "none":
        return Finding("store", "none: missions end with the edge")
    from service.storage.locks import FileLock, StoreUnusable, sqlite_file

    name = sqlite_file(settings.store)
    if name is None:
        if not settings.store.startswith("postgres"):
            return Finding("store", "AICVDS_STORE is no file and no address of PostgreSQL", "aicvds serve --store FILE")
        if find_spec("psycopg") is None:
            return Finding("store", "PostgreSQL, but psycopg is not installed", "pip install 'aic-vds[postgres]'")
        return Finding("store", "PostgreSQL (not tried)")
    file = Path(name).absolute()
    if not file.exists():
        folder = next(parent for parent in file.parents if parent.exists())
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            return Finding("store", f"{file}: {folder} cannot be written", "aicvds serve --store FILE, or --store none")
        return Finding("store", f"{file} (new)")
    try:
        FileLock(str(file)).close()
    except StoreUnusable as error:
        return Finding("store", str(error), "end that edge, or aicvds serve --store ANOTHER_FILE")
    except OSError as error:
        return Finding("store", f"{file}: {error.strerror}", "aicvds serve --store FILE, or --store none")
    return Finding("store", f"{file}, {file.stat().st_size / 1e6:.1f} MB, free")


def llm_servers(settings: Settings) -> Iterator[Finding]:
    """The abilities of each LLM server and the time of one decision, asked as the edge asks."""
    for one in settings.each_server():
        yield from _llm_server(one)


def _llm_server(settings: Settings) -> Iterator[Finding]:
    from service.llm.answers import NoDecision
    from service.llm.probing import examine
    from service.mission.prompt_fit import warm_up

    async def examined() -> "Examination":
        async with asyncio.timeout(settings.llm_load_s):
            return await examine(settings, warm_up(settings))

    try:
        found = asyncio.run(examined())
    except TimeoutError:
        remedy = "start the server, or wait until it has loaded its model"
        yield Finding("LLM", f"{settings.llm_url}: no answer in {settings.llm_load_s:g} s", remedy)
        return
    except NoDecision as error:
        yield Finding("LLM", str(error), _REMEDIES.get(error.reason, _REMEDIES["llm_error"]))
        return
    yield Finding("LLM", f"{settings.llm_url}: {found.abilities.model or 'the default model of the server'}")
    yield Finding("LLM", f"{found.abilities}{f'; with {found.terms}' if found.terms else ''}")
    late = found.seconds * 1e3 > settings.deadline_ms
    yield Finding("LLM", _timed(found, settings.deadline_ms), _LATE if late else None)


def _timed(found: "Examination", deadline_ms: int) -> str:
    tokens = ""
    if found.answer.prompt_tokens is not None and found.answer.completion_tokens is not None:
        cached = f" ({found.answer.cached_tokens} cached)" if found.answer.cached_tokens is not None else ""
        read = found.answer.prompt_tokens - (found.answer.cached_tokens or 0)
        rate = (read + found.answer.completion_tokens) / max(found.seconds, 1e-3)
        count = f"prompt {found.answer.prompt_tokens} tokens{cached}, answer {found.answer.completion_tokens}"
        tokens = f"; {count}, {rate:,.0f} a second"
    return f"a decision took {found.seconds:.2f} s of the deadline's {deadline_ms / 1e3:g} s{tokens}"


def embedded(settings: Settings) -> Iterator[Finding]:
    """Whether the embedded LLM has its library, which needs libgomp, its file and the vocabulary."""
    from service.llm.model_file import ModelMissing, embedded_model

    if subprocess.run([sys.executable, "-P", "-c", "import xllamacpp"], capture_output=True, check=False).returncode:
        remedy = "apt-get install libgomp1, pip install 'aic-vds[service]', or set AICVDS_LLM_URL"
        yield Finding("LLM", "llama.cpp (xllamacpp) cannot be loaded", remedy)
        return
    try:
        file = embedded_model(settings)
    except ModelMissing as error:
        yield Finding("LLM", str(error).partition(":")[0], "aicvds model fetch")
        return
    adapter, orders = settings.embedded_adapter, settings.embedded_orders
    for one, setting in ((adapter, "ADAPTER"), (orders, "ORDERS")):
        if one is not None and not one.is_file():
            yield Finding("LLM", f"adapter {one} is not there", f"correct or unset AICVDS_LLM_{setting}")
    with_adapter = "no adapter" if adapter is None else f"adapter {adapter}"
    size = f"{file.stat().st_size / 1e6:.0f} MB"
    yield Finding("LLM", f"embedded, {file} ({size}), {with_adapter}, {settings.embedded_threads} threads")


def planner(settings: Settings) -> Finding:
    """Whether the fleet's planner can work."""
    if settings.planner == "off":
        return Finding("planner", "off: one step of look-ahead")
    free_mb = shutil.disk_usage(next(at for at in (Path.home(), *Path.home().parents) if at.exists())).free / 1e6
    return Finding("planner", f"numba {version('numba')}; {free_mb:,.0f} MB of disk free")
