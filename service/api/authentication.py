"""Authentication by API key, with scopes and a rate limit for each key."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence

from limits import RateLimitItemPerMinute
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

from service.api.api_keys import ApiKey, ApiKeys, Scope
from service.api.load_limits import READING
from service.api.problem_details import problem_response

# Resources without mission data. Probes of containers and load balancers carry no key.
_OPEN = frozenset(("/healthz", "/readyz", "/"))
# The page's scripts and styles; the page requests its data with a key.
_OPEN_PREFIX = "/static/"
_ATTENTION = re.compile(r"/missions/[^/]+/attention")
_READINGS = re.compile(r"/missions/[^/]+/readings")
# The ASGI scope's entry with the scopes of the request's key.
SCOPES = "aicvds.scopes"
# The ASGI scope's entry for streams: a function that returns whether the key is still known.
STILL_KNOWN = "aicvds.still_known"


def scope_of(method: str, path: str) -> Scope | None:
    """The scope that a key needs for a request; None where no key is needed, or any key may read."""
    if method in READING:
        # UAVs that prune their reports need the weights, so the scope `decide` is required.
        return "decide" if _ATTENTION.fullmatch(path) else None
    if _READINGS.fullmatch(path):
        return "readings"
    return "admin" if path.startswith("/missions") else "decide"


def is_open(method: str, path: str) -> bool:
    """Whether the request needs no key."""
    # Other methods need a key: their bodies would be read for nothing.
    return method in READING and (path in _OPEN or path.startswith(_OPEN_PREFIX))


class KeyAuthentication:
    """Pure ASGI middleware: 401 without a known key, 403 without the scope, 429 with ``Retry-After`` past the rate.

    It answers before the body is read. Clients send keys as ``Authorization: Bearer KEY``.
    """

    def __init__(self, app: ASGIApp, keys: ApiKeys) -> None:
        self.app = app
        self._keys = keys
        self._rates = SlidingWindowCounterRateLimiter(MemoryStorage())

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or is_open(scope["method"], scope["path"]):
            await self.app(scope, receive, send)
            return
        presented = _presented(scope["headers"])
        key = self._keys.find(presented)
        needed = scope_of(scope["method"], scope["path"])
        if key is None:
            refusal = problem_response(401, "send a known key as `Authorization: Bearer KEY`")
            refusal.headers["WWW-Authenticate"] = "Bearer"
        elif needed is not None and needed not in key.scopes:
            refusal = problem_response(403, f"key {key.name} lacks the scope {needed}")
        elif (wait_s := await self._wait(key)) is not None:
            refusal = problem_response(429, f"key {key.name} has a limit of {key.per_minute} requests a minute")
            refusal.headers["Retry-After"] = str(wait_s)
        else:
            scope[SCOPES] = key.scopes
            scope[STILL_KNOWN] = lambda: self._keys.find(presented) is not None
            await self.app(scope, receive, send)
            return
        # The connection ends, so that the server does not wait for the rest of the request.
        refusal.headers["Connection"] = "close"
        await refusal(scope, receive, send)

    async def _wait(self, key: ApiKey) -> int | None:
        """Seconds until the key's next request is allowed; None where this one is, which then counts."""
        rate = RateLimitItemPerMinute(key.per_minute)
        if await self._rates.hit(rate, key.name):
            return None
        stats = await self._rates.get_window_stats(rate, key.name)
        return max(1, math.ceil(stats.reset_time - time.time()))


def _presented(headers: Sequence[tuple[bytes, bytes]]) -> str:
    """The bearer token; empty where the request has none or several."""
    given = [value for name, value in headers if name.lower() == b"authorization"]
    if len(given) != 1:
        return ""
    scheme, _, token = given[0].decode("latin-1").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""
