"""A lease that another edge has had in the meantime is not this edge's any more, whatever its present epoch."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from typing import cast

import pytest

from service.edge.ownership import LeasedOwnership
from service.observability.metrics import Metrics
from service.storage.leases import Leases


class Database:
    """Leases that this edge has under given epochs."""

    def __init__(self, claimed: int, renewed: int) -> None:
        self.claimed, self.renewed = claimed, renewed

    def acquire(self, mission_id: str, address: str, term_s: float, known: int) -> int:
        return self.claimed

    def renew(self, term_s: float) -> dict[str, int]:
        return {"m": self.renewed}

    def lost(self, missions: Collection[tuple[str, int]]) -> set[tuple[str, int]]:
        return set()

    def started(self) -> object:
        return 0

    def unowned(self) -> list[str]:
        return []

    def release(self) -> None:
        """Nobody waits for it."""


@pytest.mark.parametrize(("renewed", "owned"), [(1, True), (3, False)])
async def test_a_lease_is_renewed_only_under_the_epoch_that_this_edge_knows(renewed: int, owned: bool) -> None:
    found: asyncio.Future[bool] = asyncio.get_running_loop().create_future()

    def on_round(taken: set[str], unowned: list[str], anew: bool) -> None:
        if not found.done():
            found.set_result(ownership.owns("m"))

    ownership = LeasedOwnership(
        cast("Leases", Database(claimed=1, renewed=renewed)), "http://here:1", 1.5, Metrics(), on_round
    )
    ownership.claim("m")
    try:
        assert await found is owned
    finally:
        ownership.close()


@pytest.mark.parametrize("reclaimed", [True, False])
async def test_a_lease_that_is_claimed_again_during_a_renewal_is_not_lost(reclaimed: bool) -> None:
    """The renewal has seen the lease of before, which another edge has had since."""
    rounds: asyncio.Queue[set[str]] = asyncio.Queue()

    class Meanwhile(Database):
        def renew(self, term_s: float) -> dict[str, int]:
            if reclaimed and self.claimed == 1:
                self.claimed = 3
                ownership.claim("m")
            return {}

        def lost(self, missions: Collection[tuple[str, int]]) -> set[tuple[str, int]]:
            return {mission for mission in missions if mission[1] == 1}

    ownership = LeasedOwnership(
        cast("Leases", Meanwhile(claimed=1, renewed=0)),
        "http://here:1",
        1.5,
        Metrics(),
        lambda taken, unowned, anew: rounds.put_nowait(taken),
    )
    ownership.claim("m")
    try:
        assert await rounds.get() == (set() if reclaimed else {"m"})
    finally:
        ownership.close()
