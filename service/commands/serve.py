"""``aicvds serve``: the edge as a process."""

from __future__ import annotations

import gc
import ipaddress
import logging
import os
import re
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import ValidationError

from shared.kit.validation_messages import problem_of
from shared.wire.schemas import Mode

if TYPE_CHECKING:
    from fastapi import FastAPI

    from service.config.settings import Settings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServeOptions:
    """Run the edge decision service.

    Decides at once by its LLM-free policy, and by the LLM as soon as that is loaded (watch /readyz). With no LLM server
    it embeds SmolLM2-135M; `aicvds model fetch` brings the file. Everything else is set by environment variables
    AICVDS_*: see the table in docs/reference/settings.md. `aicvds doctor` looks for what may be in the way.

    Try it:  curl localhost:8000/readyz
    """

    host: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """Address to listen on; 0.0.0.0 for every interface. Any but loopback needs AICVDS_KEYS, or AICVDS_ANONYMOUS=on.
    Default: AICVDS_HOST, or 127.0.0.1."""
    port: Annotated[int | None, tyro.conf.arg(metavar="0-65535", help_behavior_hint="")] = None
    """Port to listen on; 0 picks a free one. Default: AICVDS_PORT, or 8000."""
    mode: Annotated[Mode | None, tyro.conf.arg(metavar="guided|llm|value|policy", help_behavior_hint="")] = None
    """Who decides where a mission does not say. Default: AICVDS_MODE, or guided."""
    llm_url: Annotated[str | None, tyro.conf.arg(metavar="URL", help_behavior_hint="")] = None
    """An LLM server with OpenAI's interface, up to and including /v1. Default: AICVDS_LLM_URL, or the embedded LLM."""
    llm_model: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """The model at that server. Default: AICVDS_LLM_MODEL, or its first chat model."""
    store: Annotated[str | None, tyro.conf.arg(metavar="FILE|URL|none", help_behavior_hint="")] = None
    """SQLite file, or URL of a PostgreSQL, for the missions; none: memory. Default: AICVDS_STORE, or a file at home."""

    ray: Annotated[str | None, tyro.conf.arg(metavar="local|auto|HOST:PORT", help_behavior_hint="")] = None
    """Be the ingress of edges on Ray: on a Ray that starts here (local), or on the cluster of this machine. Needs the
    extra `ray`, and PostgreSQL."""
    replicas: Annotated[str, tyro.conf.arg(metavar="N|N-M")] = "1-4"
    """With --ray: how many edges, or from how many to how many, by load."""

    def settings(self) -> dict[str, Any]:
        """The settings that were given as options; the environment has the others."""
        given = {name: getattr(self, name) for name in ("host", "port", "mode", "llm_url", "llm_model", "store")}
        return {name: value for name, value in given.items() if value is not None}


def main(argv: list[str]) -> int:
    """Serve until SIGTERM (exit code 0) or Ctrl-C; returns the exit code."""
    # GNU OpenMP's threads spin at llama.cpp's barriers, even while another process has the core that they wait for. The
    # library reads this variable once, when llama.cpp loads it.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    args = tyro.cli(ServeOptions, prog="aicvds serve", args=argv)
    if _logs_json():
        from service.observability import logs

        # The settings' own faults are lines of JSON too.
        logs.configure("info", "json")
    # The edges on a cluster listen on their machines' addresses.
    settings = checked_settings(args.settings(), None if args.ray in (None, "local") else f"Ray at {args.ray}")
    if settings is None:
        return 2
    replicas = _bounds(args.replicas)
    if replicas is None:
        return _refused(f"--replicas {args.replicas}: give a number from 1 to 1000, or two such as 2-8")
    if args.ray is not None and not settings.store.startswith("postgres"):
        return _refused("--ray: edges on several machines share a store only in PostgreSQL: set AICVDS_STORE")
    try:
        family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
        listener = socket.create_server((settings.host, settings.port), family=family)
    except OSError as error:
        other = "; choose another --port, or 0 for a free one" if settings.port else ""
        return _refused(f"cannot listen on {settings.host}:{settings.port}: {error.strerror or error}{other}")
    url = f"http://{f'[{settings.host}]' if ':' in settings.host else settings.host}:{listener.getsockname()[1]}"
    # uvicorn raises the signal again once it has ended.
    on_sigterm = signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        # The system queues requests from here on. /healthz answers at once, the other routes once all is loaded.
        _say(f"aicvds serve: listening on {url}, loading")
        # Nearly every object made while loading stays, and collecting garbage would take a tenth of the time.
        gc.disable()
        with listener:
            if args.ray is not None:
                return _serve_cluster(listener, settings, args.ray, *replicas)
            return _serve(listener, settings, url)
    except KeyboardInterrupt:
        return 130
    finally:
        signal.signal(signal.SIGTERM, on_sigterm)
        gc.enable()


def checked_settings(given: dict[str, Any], host: str | None = None) -> Settings | None:
    """The settings, where an edge can listen on ``host`` (by default its own); None once the faults are printed."""
    from service.config.settings import Settings, unknown_variables

    for name, meant in unknown_variables().items():
        _say(f"aicvds serve: {name} is no setting and changes nothing{meant}", logging.WARNING)
    try:
        settings = Settings(**given)
    except ValidationError as error:
        for fault in error.errors():
            field = "_".join(str(part) for part in fault["loc"])
            name = f"--{field.replace('_', '-')}" if field in given else f"AICVDS_{field.upper()}".removesuffix("_")
            _refused(f"{name}: {problem_of(fault)}")
        return None
    if (refusal := fault_of_keys(settings, host or settings.host)) is not None:
        _refused(refusal)
    return settings if refusal is None else None


def fault_of_keys(settings: Settings, host: str) -> str | None:
    """Why an edge does not listen on this host with the keys of its settings; None if it does."""
    from service.api.api_keys import ApiKeys, BadKeys

    if settings.keys is None and settings.anonymous == "off" and not _is_loopback(host):
        return (
            f"anyone who reaches {host} could control this fleet. Make a key with "
            "`aicvds keys add NAME --file keys.json`, set AICVDS_KEYS=keys.json, or say AICVDS_ANONYMOUS=on"
        )
    if settings.keys is not None:
        try:
            ApiKeys(settings.keys)
        except BadKeys as error:
            return f"AICVDS_KEYS: {error}"
    return None


def _serve(listener: socket.socket, settings: Settings, url: str) -> int:
    from service.observability import logs
    from service.server.server import Server, hand_back_memory

    hand_back_memory()
    logs.configure(settings.log_level, settings.log_format)
    # A machine reads a log of JSON: it gets no banner.
    loaded = (lambda text: None) if _logs_json() else _say
    server = Server(partial(_application, settings, url, loaded), settings.log_level)
    server.run(sockets=[listener])
    if isinstance(server.error, (_Unusable, OSError)):
        return _refused(str(server.error))
    if server.error is not None:
        raise server.error
    return 0


def _serve_cluster(listener: socket.socket, settings: Settings, ray: str, least: int, most: int) -> int:
    from service.cluster.ingress import serve_cluster
    from service.observability import logs
    from shared.kit.ray_connection import RayUnusable

    logs.configure(settings.log_level, settings.log_format)
    try:
        server = serve_cluster(listener, settings, ray, least, most)
        if server.error is not None:
            raise server.error
    except RayUnusable as error:
        return _refused(str(error))
    return 0


def _bounds(replicas: str) -> tuple[int, int] | None:
    """The bounds of ``--replicas``; None if it is malformed."""
    least, _, most = replicas.partition("-")
    if not (least.isdecimal() and (most or least).isdecimal()):
        return None
    bounds = int(least), int(most or least)
    return bounds if 1 <= bounds[0] <= bounds[1] <= 1000 else None


def _application(settings: Settings, url: str, loaded: Callable[[str], None]) -> FastAPI:
    """Import the application and make the edge; raises ``_Unusable``."""
    from service.api.api_keys import BadKeys
    from service.api.app import create_app
    from service.commands.banner import banner
    from service.storage.locks import StoreUnusable
    from service.storage.store import Store

    # As other machines know an edge that listens on every interface.
    reachable = re.sub(r"//(0\.0\.0\.0|\[::\])", f"//{socket.gethostname()}", url)
    settings = settings.model_copy(update={"advertise_url": settings.advertise_url or reachable})
    try:
        store = None if settings.store == "none" else Store(settings.store)
        app = create_app(settings, store)
    except BadKeys as error:
        raise _Unusable(f"AICVDS_KEYS: {error}") from None
    except StoreUnusable as error:
        fault = f"AICVDS_STORE: {error}. Give another (--store FILE), or `--store none` to store nothing"
        raise _Unusable(fault) from None
    loaded(banner(settings, url, 0 if store is None else len(store.missions())))
    return app


class _Unusable(Exception):
    """A file or a store that a setting names cannot be used."""


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _say(text: str, level: int = logging.INFO) -> None:
    """Print to stderr, or log where the log is JSON."""
    if _logs_json():
        log.log(level, "%s", text)
    else:
        print(text, file=sys.stderr, flush=True)


def _logs_json() -> bool:
    return os.environ.get("AICVDS_LOG_FORMAT") == "json"


def _refused(fault: str) -> int:
    _say(f"aicvds serve: {fault}", logging.ERROR)
    return 2
