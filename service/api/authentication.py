"""Authentication by API key, with scopes and a rate limit for each key; without keys, a check of the name asked."""

import math
import re
import socket
import time
from collections.abc import Awaitable, Callable, Sequence
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from service.api.api_keys import MOST_KEYS, ApiKey, ApiKeys, Scope
from service.api.problem_details import problem_response, refusal_of
from service.api.request_limits import READING
from service.config.settings import Settings
from service.errors import NotFound
from shared.kit.bounded import BoundedDict

# Resources without mission data. Probes of containers and load balancers carry no key.
_OPEN = frozenset(("/healthz", "/readyz", "/"))
# The page's scripts and styles; the page requests its data with a key.
_OPEN_PREFIX = "/static/"
_ATTENTION = re.compile(r"/missions/[^/]+/attention")
# The mission of every route below /missions/{id}, so that a new route is bound too.
_MISSION = re.compile(r"/missions/([^/]+)")
_READINGS = re.compile(r"/missions/[^/]+/readings")
_MINUTE_S = 60.0
# The ASGI scope's entry with the request's key.
KEY = "aicvds.key"
# The ASGI scope's entry for streams: a function that returns whether the key is still known, and for this mission.
STILL_KNOWN = "aicvds.still_known"
_PORT = re.compile(r":\d*$")


def scope_of(method: str, path: str) -> Scope | None:
    """The scope that a request needs; None if no key is needed, or any key may read."""
    if method in READING:
        # UAVs that prune their reports need the weights, so the scope `decide` is required.
        return "decide" if _ATTENTION.fullmatch(path) else None
    if _READINGS.fullmatch(path):
        return "readings"
    return "admin" if path.startswith("/missions") else "decide"


def is_open(method: str, path: str) -> bool:
    """Whether the request needs no key."""
    # Other methods need a key, so that their bodies are not read in vain.
    return method in READING and (path in _OPEN or path.startswith(_OPEN_PREFIX))


class KeyAuthentication:
    """Pure ASGI middleware: 401 without a known key, 403 without the scope, 429 with ``Retry-After`` past the rate.

    A mission that the key is not bound to gets 404, whether or not it is there. It answers before the body is read.
    Clients send keys as ``Authorization: Bearer KEY``. A key's requests of a minute may come at once, and then evenly
    (the generic cell rate algorithm).
    """

    def __init__(self, app: ASGIApp, keys: ApiKeys, clock: Callable[[], float] = time.monotonic) -> None:
        self.app = app
        self._keys = keys
        self._clock = clock
        # When a key's requests so far would have ended had they come evenly; by rate, so that another one begins anew.
        self._even_end_s = BoundedDict[tuple[str, int], float](4 * MOST_KEYS)

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or is_open(scope["method"], scope["path"]):
            await self.app(scope, receive, send)
            return
        presented = _presented(scope["headers"])
        key = self._keys.find(presented)
        needed, mission = scope_of(scope["method"], scope["path"]), _MISSION.match(scope["path"])
        if key is None:
            refusal = problem_response(401, "send a known key as `Authorization: Bearer KEY`")
            refusal.headers["WWW-Authenticate"] = "Bearer"
        elif needed is not None and needed not in key.scopes:
            refusal = problem_response(403, f"key {key.name} lacks the scope {needed}")
        elif (wait_s := self._wait(key)) is not None:
            refusal = problem_response(429, f"key {key.name} has a limit of {key.per_minute} requests a minute")
            refusal.headers["Retry-After"] = str(wait_s)
        elif mission is not None and not key.allows(mission[1]):
            refusal = refusal_of(no_mission(key, mission[1]))
        else:
            scope[KEY] = key
            scope[STILL_KNOWN] = lambda: (
                (now := self._keys.find(presented)) is not None and (mission is None or now.allows(mission[1]))
            )
            await self.app(scope, receive, send)
            return
        # The connection is closed, so that the server does not wait for the rest of the request.
        refusal.headers["Connection"] = "close"
        await refusal(scope, receive, send)

    def _wait(self, key: ApiKey) -> int | None:
        """Seconds until the key's next request is allowed; None if this one is, which then counts."""
        now, each_s = self._clock(), _MINUTE_S / key.per_minute
        ends = max(now, self._even_end_s.get((key.name, key.per_minute), now)) + each_s
        # A millionth of a second is rounding.
        if (wait_s := ends - now - _MINUTE_S) > 1e-6:
            return math.ceil(wait_s)
        self._even_end_s[key.name, key.per_minute] = ends
        return None


def no_mission(key: ApiKey, mission_id: str) -> NotFound:
    """The refusal of a mission that the request's key is not bound to, whether or not there is one."""
    bound = ", ".join(key.missions or ())
    return NotFound("mission_id", f"there is no mission {mission_id} for key {key.name}, which is bound to {bound}")


def _presented(headers: Sequence[tuple[bytes, bytes]]) -> str:
    """The bearer token; empty if the request has none or several."""
    given = [value for name, value in headers if name.lower() == b"authorization"]
    if len(given) != 1:
        return ""
    scheme, _, token = given[0].decode("latin-1").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


class KnownHosts:
    """Pure ASGI middleware: 403 for a request to a name that is neither this machine's nor listed in the settings.

    An edge with keys answers to every name. With ``AICVDS_ANONYMOUS=on`` all addresses and this machine's name are
    known. A request without Host comes from no browser.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        names = {_PORT.sub("", name.strip().lower()).strip("[]") for name in settings.hosts.split(",")}
        self._checks = settings.keys is None and "*" not in names
        self._any_address = settings.anonymous == "on"
        own = {"localhost", urlsplit(settings.advertise_url or "").hostname or "localhost"}
        self._names = names - {""} | own | ({socket.gethostname().lower()} if self._any_address else set())

    def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> Awaitable[None]:
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
