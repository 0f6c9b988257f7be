"""An HTTP transport that delays and loses requests, as the radio link of a scenario with a lossy uplink."""

import random
import time

import httpx


class LossyTransport(httpx.BaseTransport):
    """Delays every request by up to ``jitter_ms`` and loses a share ``drop`` of the requests.

    A lost request never reaches the edge: after its delay it raises ``httpx.ConnectTimeout``, which the client retries
    like a real loss. The draws depend only on ``seed``, two a request, so a repeated mission has the same losses.

    Raises:
        ValueError: ``drop`` is no probability below 1, or ``jitter_ms`` is negative.
    """

    def __init__(self, inner: httpx.BaseTransport, *, drop: float, jitter_ms: float, seed: int) -> None:
        if not 0 <= drop < 1 or jitter_ms < 0:
            raise ValueError(f"drop must be in [0, 1) and jitter_ms at least 0, not {drop} and {jitter_ms}")
        self._inner = inner
        self._drop = drop
        self._jitter_s = jitter_ms / 1000
        self._random = random.Random(f"uplink-{seed}")

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Forward the request after a delay, or lose it.

        Raises:
            httpx.ConnectTimeout: the request was lost.
        """
        delay, luck = self._random.random() * self._jitter_s, self._random.random()
        time.sleep(delay)
        if luck < self._drop:
            raise httpx.ConnectTimeout("the uplink lost the request", request=request)
        return self._inner.handle_request(request)

    def close(self) -> None:
        """Close the wrapped transport."""
        self._inner.close()
