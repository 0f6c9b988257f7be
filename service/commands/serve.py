"""``aicvds serve``: the edge as a process."""

from __future__ import annotations

import gc
import ipaddress
import socket
import sys
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import tyro
from pydantic import ValidationError

if TYPE_CHECKING:
    from fastapi import FastAPI

    from service.config.settings import Settings


@dataclass(frozen=True)
class Serve:
    """Run the edge decision service.

    Decides at once by its LLM-free policy, and by the LLM as soon as that is loaded (watch /readyz). With no
    AICVDS_LLM_URL it embeds SmolLM2-135M; `aicvds model fetch` brings the file. Everything else is set by
    environment variables AICVDS_*: see the table in docs/operations.md.

    Try it:  curl localhost:8000/readyz
    """

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 for every interface. Any but loopback needs AICVDS_KEYS, or AICVDS_ANONYMOUS=on."""
    port: Annotated[int, tyro.conf.arg(metavar="0-65535")] = 8000
    """Port to listen on; 0 picks a free one."""


def main(argv: list[str]) -> int:
    """Serve until SIGTERM or Ctrl-C; returns the exit code."""
    args = tyro.cli(Serve, prog="aicvds serve", args=argv)
    if not 0 <= args.port <= 65535:
        return _refused(f"--port {args.port} is not between 0 and 65535")
    try:
        family = socket.AF_INET6 if ":" in args.host else socket.AF_INET
        listener = socket.create_server((args.host, args.port), family=family)
    except OSError as error:
        return _refused(f"cannot listen on {args.host}:{args.port}: {error.strerror or error}")
    host = f"[{args.host}]" if ":" in args.host else args.host
    try:
        # The system queues requests from here on. /healthz answers at once, the other routes once torch is loaded.
        print(
            f"aicvds serve: running on http://{host}:{listener.getsockname()[1]}, loading", file=sys.stderr, flush=True
        )
        # Nearly every object made while loading stays, and collecting garbage would take a tenth of the time.
        gc.disable()
        with listener:
            return _serve(listener, args.host)
    except KeyboardInterrupt:
        return 130
    finally:
        gc.enable()


def _serve(listener: socket.socket, host: str) -> int:
    from service.config.settings import Settings, unknown_variables
    from service.server.malloc import hand_back_memory

    hand_back_memory()

    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors():
            name = "AICVDS_" + "_".join(str(part) for part in fault["loc"]).upper()
            _refused(f"{name}: {fault['msg']}")
        return 2
    for name in unknown_variables():
        print(f"aicvds serve: {name} is no setting and changes nothing", file=sys.stderr)

    if settings.keys is None and settings.anonymous == "off" and not _is_loopback(host):
        return _refused(
            f"anyone who reaches {host} could control this fleet. Make a key with "
            "`aicvds keys add NAME --file keys.json`, set AICVDS_KEYS=keys.json, or say AICVDS_ANONYMOUS=on"
        )

    from service.observability import logs
    from service.server.server import Server

    logs.configure(settings.log_level, settings.log_format)
    server = Server(partial(_application, settings), settings.log_level)
    server.run(sockets=[listener])
    if isinstance(server.error, _Unusable):
        return _refused(str(server.error))
    if server.error is not None:
        raise server.error
    return 0


def _application(settings: Settings) -> FastAPI:
    """Import torch and make the edge; raises ``_Unusable``."""
    from service.api.api_keys import BadKeys
    from service.api.app import create_app
    from service.storage.locks import StoreUnusable
    from service.storage.store import Store

    try:
        return create_app(settings, None if settings.store == "none" else Store(settings.store))
    except BadKeys as error:
        raise _Unusable(f"AICVDS_KEYS: {error}") from None
    except StoreUnusable as error:
        raise _Unusable(f"AICVDS_STORE: {error}. Give another, or `none` to store nothing") from None


class _Unusable(Exception):
    """A file or a store that a setting names cannot be used."""


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _refused(fault: str) -> int:
    print(f"aicvds serve: {fault}", file=sys.stderr)
    return 2
