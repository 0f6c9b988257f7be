"""The names by which clients may reach an edge without keys.

A web page can give its own name this machine's address (DNS rebinding), and the browser then lets the page's scripts
send any request to the edge. The header Host still has the page's name.
"""

import re
import socket
from collections.abc import Awaitable
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.problem_details import problem_response
from service.config.settings import Settings

_PORT = re.compile(r":\d*$")


class KnownHosts:
    """Pure ASGI middleware: 403 for a request to a name that is neither this machine's nor listed in the settings.

    An edge with keys answers to every name. With ``AICVDS_ANONYMOUS=on`` all addresses and this machine's name are
    known. A request without Host comes from no browser.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        names = {name.strip().lower() for name in settings.hosts.split(",")}
        self._checks = settings.keys is None and "*" not in names
        self._any_address = settings.anonymous == "on"
        own = {"localhost", urlsplit(settings.advertise_url or "").hostname or "localhost"}
        self._names = names - {""} | own | ({socket.gethostname().lower()} if self._any_address else set())

    def __call__(self, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        if self._checks and scope["type"] == "http":
            hosts = [value for name, value in scope["headers"] if name == b"host"]
            if len(hosts) > 1 or not all(map(self._known, hosts)):
                refusal = problem_response(
                    403, "without API keys the edge answers to this machine's names and those in AICVDS_HOSTS only"
                )
                refusal.headers["Connection"] = "close"
                return refusal(scope, receive, send)
        return self.app(scope, receive, send)

    def _known(self, host: bytes) -> bool:
        name = _PORT.sub("", host.decode("latin-1")).lower().strip("[]").rstrip(".")
        if name in self._names:
            return True
        try:
            address = ip_address(name)
        except ValueError:
            return False
        return self._any_address or address.is_loopback
