"""The pauses before a request is sent again, and the answers that it is sent again for."""

from __future__ import annotations

from collections.abc import Callable

import httpx
import pytest

from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeUnreachable


def pauses_of(answer: Callable[[], httpx.Response], attempts: int = 2, seed: int = 0) -> list[float]:
    """The pauses of a request that gets this answer each time."""
    pauses: list[float] = []
    transport = httpx.MockTransport(lambda request: answer())
    client = EdgeClient("http://edge", attempts=attempts, seed=seed, transport=transport, sleep=pauses.append)
    with client as edge, pytest.raises(EdgeUnreachable, match=f"was tried {attempts} times"):
        edge.mission("m")
    return pauses


@pytest.mark.parametrize("status", [408, 429, 502, 503, 504])
def test_what_a_busy_edge_or_a_proxy_answers_is_tried_again(status: int) -> None:
    assert len(pauses_of(lambda: httpx.Response(status), attempts=3)) == 2


@pytest.mark.parametrize(
    ("retry_after", "pause_s"),
    [
        ("3", 3.0),
        ("0.25", 0.25),
        ("5", 5.0),
        ("60", 5.0),
        ("-4", 0.0),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 0.0),
        ("Wed, 21 Oct 2215 07:28:00 GMT", 5.0),
    ],
)
def test_a_server_may_ask_for_a_pause_of_five_seconds_at_most(retry_after: str, pause_s: float) -> None:
    assert pauses_of(lambda: httpx.Response(503, headers={"Retry-After": retry_after})) == [pause_s]


@pytest.mark.parametrize("retry_after", ["soon", "inf", "nan", ""])
def test_a_pause_that_is_none_is_the_clients_own(retry_after: str) -> None:
    own = pauses_of(lambda: httpx.Response(503))
    assert pauses_of(lambda: httpx.Response(503, headers={"Retry-After": retry_after})) == own


def test_the_pauses_are_random_and_their_limit_doubles_to_two_seconds() -> None:
    pauses = [pauses_of(lambda: httpx.Response(503), attempts=8, seed=seed) for seed in range(40)]
    limits = (0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0)
    for of_attempt, limit_s in zip(zip(*pauses, strict=True), limits, strict=True):
        assert 0.0 <= min(of_attempt) < 0.2 * limit_s and 0.8 * limit_s < max(of_attempt) <= limit_s
