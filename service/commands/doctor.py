"""``aicvds doctor``: problems that may keep an edge from running here, and their remedies."""

from __future__ import annotations

import json
import os
import platform
import shutil
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import tyro
from pydantic import ValidationError

from service.config.settings import Settings, unknown_variables
from shared.kit.validation_messages import problem_of
from shared.wire.schemas import LLM_MODES

_ASKED_S = 3.0
_SUPPORTED = ((3, 11), (3, 13))


@dataclass(frozen=True)
class Doctor:
    """Check this machine for an edge: versions, settings, port, store, LLM, planner.

    Each line has one finding. A line with !! says what to type. Nothing is changed. The settings are those that
    `aicvds serve` would have: the variables AICVDS_*.

    Try it:  aicvds doctor

    Exit code: 0 nothing is in the way, 1 something is.
    """

    host: str = "127.0.0.1"
    """Address that the edge is to listen on."""
    port: Annotated[int, tyro.conf.arg(metavar="1-65535")] = 8000
    """Port that the edge is to listen on."""


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
    if not 1 <= options.port <= 65535:
        print(f"aicvds doctor: --port {options.port} is not between 1 and 65535", file=sys.stderr)
        return 2
    trouble = 0
    for finding in findings(options.host, options.port):
        print(finding, flush=True)
        trouble += finding.remedy is not None
    print(f"{trouble} in the way" if trouble else "Nothing is in the way. Next:  aicvds serve")
    return 1 if trouble else 0


def findings(host: str, port: int) -> Iterator[Finding]:
    """All findings, in the order in which a start would meet them."""
    yield versions()
    yield port_of(host, port)
    for name, meant in unknown_variables().items():
        yield Finding("settings", f"{name} is no setting and changes nothing{meant}", f"unset {name}")
    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors():
            name = "AICVDS_" + "_".join(str(part) for part in fault["loc"]).upper()
            found = f"{name.removesuffix('_')}: {problem_of(fault)}"
            yield Finding("settings", found, "see docs/reference/settings.md")
        return
    yield Finding("settings", f"mode {settings.mode}, deadline {settings.deadline_ms} ms, top-k {settings.top_k}")
    yield store_of(settings)
    if settings.mode in LLM_MODES:
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
    """Whether the port is free; where it is not, whether an edge has it."""
    try:
        with socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            return Finding("port", f"{host}:{port} is free")
    except OSError as error:
        fault = error.strerror or str(error)
    answer = _asked(f"http://{f'[{host}]' if ':' in host else host}:{port}/readyz")
    if isinstance(answer, dict) and "decides" in answer:
        return Finding(
            "port",
            f"{host}:{port}: an edge runs there, its LLM is {answer.get('llm')}",
            "use it, or aicvds serve --port 0",
        )
    return Finding("port", f"{host}:{port}: {fault}", "aicvds serve --port 0")


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
        if not _writable(folder):
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
    """Whether each LLM server answers, and has the model."""
    for one in settings.each_server():
        key = one.llm_api_key.get_secret_value() if one.llm_api_key else None
        answer = _asked(f"{one.llm_url}/models", key)
        if isinstance(answer, str):
            yield Finding("LLM", f"{one.llm_url}: {answer}", "start the server, or correct AICVDS_LLM_URL or _API_KEY")
            continue
        models = answer.get("data")
        if not isinstance(models, list):
            yield Finding(
                "LLM",
                f"{one.llm_url}/models lists no models",
                "check that the address ends in /v1, or set AICVDS_LLM_MODEL" if not one.llm_model else None,
            )
            continue
        listed = [str(m.get("id"))[:200] for m in models if isinstance(m, dict)]
        if one.llm_model and one.llm_model not in listed:
            names = ", ".join(listed[:5]) or "no model"
            yield Finding("LLM", f"{one.llm_url} lists {names}, not {one.llm_model}", "correct AICVDS_LLM_MODEL")
            continue
        yield Finding("LLM", f"{one.llm_url}: {one.llm_model or next(iter(listed), 'lists no model')}")


def embedded(settings: Settings) -> Iterator[Finding]:
    """Whether the embedded LLM has its library, its file and the vocabulary."""
    from service.llm.model_file import ModelMissing, embedded_model

    if find_spec("xllamacpp") is None:
        yield Finding("LLM", "xllamacpp is not installed", "pip install 'aic-vds[service]', or set AICVDS_LLM_URL")
        return
    try:
        file = embedded_model(settings)
    except ModelMissing as error:
        yield Finding("LLM", str(error).partition(":")[0], "aicvds model fetch")
        return
    adapter = settings.embedded_adapter
    with_adapter = "no adapter" if adapter is None else f"adapter {adapter}"
    size = f"{file.stat().st_size / 1e6:.0f} MB"
    yield Finding("LLM", f"embedded, {file} ({size}), {with_adapter}, {settings.embedded_threads} threads")


def planner(settings: Settings) -> Finding:
    """Whether the fleet's planner can work."""
    if settings.planner == "off":
        return Finding("planner", "off: one step of look-ahead")
    free_mb = shutil.disk_usage(Path.home()).free / 1e6
    return Finding("planner", f"numba {version('numba')}; {free_mb:,.0f} MB of disk free")


def _asked(url: str, key: str | None = None) -> Any:
    """The JSON of a GET, or the reason of a failure, as text."""
    import httpx

    headers = {"Authorization": f"Bearer {key}"} if key else {}
    try:
        answer = httpx.get(url, headers=headers, timeout=_ASKED_S)
        answer.raise_for_status()
        found = answer.json()
    except httpx.HTTPStatusError as error:
        return f"it answers {error.response.status_code}"
    except httpx.TimeoutException:
        return f"no answer in {_ASKED_S:g} s"
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        return str(error) or type(error).__name__
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        return "it answers no JSON"
    except (ImportError, ValueError) as error:
        # httpx reads the variables itself: one may name a scheme that is unknown, or SOCKS, which needs a package.
        return f"HTTP_PROXY, HTTPS_PROXY or ALL_PROXY names a proxy that cannot be used: {error}"
    return found if isinstance(found, dict) else "it answers no JSON object"


def _writable(folder: Path) -> bool:
    return folder.is_dir() and os.access(folder, os.W_OK)
