"""The guard before the door: who asks, whether that key may, and how often."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence

from limits import RateLimitItemPerMinute
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as Asked

from service.api.api_keys import ApiKey, ApiKeys, Scope
from service.api.concurrency_limit import READING
from service.api.problem_details import problem_response

# What says nothing of missions: probes of containers and load balancers carry no key.
_OPEN = frozenset(("/healthz", "/readyz", "/"))
# The page's scripts and styles; what it shows it asks for with a key.
_OPEN_BELOW = "/static/"
_ATTENTION = re.compile(r"/missions/[^/]+/attention")
# Where the guard leaves the key's scopes for the routes.
SCOPES = "aicvds.scopes"
# For answers that go on: where the guard leaves a function that says whether the key is known still.
STILL_KNOWN = "aicvds.still_known"


def scope_of(method: str, path: str) -> Scope | None:
    """What a key must be allowed for a request; None where none is needed, or any will do for reading."""
    if method in READING:
        # What was learned is told to those who fly by it.
        return "decide" if _ATTENTION.fullmatch(path) else None
    return "admin" if path.startswith("/missions") else "decide"


def is_open(method: str, path: str) -> bool:
    """Whether no key is asked for."""
    # Nothing else is done there: a stranger's body would only be waited for.
    return method in READING and (path in _OPEN or path.startswith(_OPEN_BELOW))


def may_make_missions(request: Request) -> bool:
    """Whether who asks may make a mission by asking about one that there is not: with a key, only an admin."""
    scopes: frozenset[Scope] | None = request.scope.get(SCOPES)
    return scopes is None or "admin" in scopes


class KeyAuthentication:
    """Pure ASGI middleware. Answers 401 without a known key, 403 where it may not, 429 with ``Retry-After`` too often.

    Nothing of the body is read before. Keys come as ``Authorization: Bearer KEY``.
    """

    def __init__(self, app: ASGIApp, keys: ApiKeys) -> None:
        self.app = app
        self._keys = keys
        self._rates = SlidingWindowCounterRateLimiter(MemoryStorage())

    async def __call__(self, scope: Asked, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or is_open(scope["method"], scope["path"]):
            await self.app(scope, receive, send)
            return
        presented = _presented(scope["headers"])
        key = self._keys.find(presented)
        needed = scope_of(scope["method"], scope["path"])
        if key is None:
            refusal = problem_response(401, "give a key that is known as `Authorization: Bearer KEY`")
            refusal.headers["WWW-Authenticate"] = "Bearer"
        elif needed is not None and needed not in key.scopes:
            refusal = problem_response(403, f"key {key.name} may not do this: it lacks the scope {needed}")
        elif (wait_s := await self._wait(key)) is not None:
            refusal = problem_response(429, f"key {key.name} may ask {key.per_minute} times a minute")
            refusal.headers["Retry-After"] = str(wait_s)
        else:
            scope[SCOPES] = key.scopes
            scope[STILL_KNOWN] = lambda: self._keys.find(presented) is not None
            await self.app(scope, receive, send)
            return
        # The rest of what is sent is not waited for.
        refusal.headers["Connection"] = "close"
        await refusal(scope, receive, send)

    async def _wait(self, key: ApiKey) -> int | None:
        """Seconds until the key may ask again; None where it may now, which then counts."""
        rate = RateLimitItemPerMinute(key.per_minute)
        if await self._rates.hit(rate, key.name):
            return None
        stats = await self._rates.get_window_stats(rate, key.name)
        return max(1, math.ceil(stats.reset_time - time.time()))


def _presented(headers: Sequence[tuple[bytes, bytes]]) -> str:
    """The bearer token, empty where there is none or more than one."""
    given = [value for name, value in headers if name.lower() == b"authorization"]
    if len(given) != 1:
        return ""
    scheme, _, token = given[0].decode("latin-1").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""
