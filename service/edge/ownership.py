"""Ownership of stored missions: all of an exclusive store, or those whose leases this edge has."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from service.errors import Misdirected
from service.observability.metrics import Metrics
from service.storage.leases import LeaseHolder, Leases
from service.storage.store import cause

log = logging.getLogger(__name__)

# Renewals of the leases per term, and after a failure.
_ROUNDS, _ROUNDS_FAILING = 3, 10


class SoleOwnership:
    """The store is exclusive to this edge, or there is none: the edge owns every mission."""

    shared = False
    intact = True

    def owns(self, mission_id: str) -> bool:
        """True."""
        return True

    def claim(self, mission_id: str) -> int:
        """Return 0: no lease is needed."""
        return 0

    def check_free(self, mission_id: str) -> None:
        """Do nothing: there is no other edge."""

    def epoch(self, mission_id: str) -> int:
        """Return 0, the epoch without leases."""
        return 0

    def forget(self, mission_id: str) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


@dataclass(slots=True)
class _Lease:
    """A lease of this edge: its epoch, and the time until which it is valid for certain, by this machine's clock."""

    epoch: int
    until: float


class LeasedOwnership:
    """The missions of a shared store whose leases this edge has.

    A thread renews the leases three times a term. This edge's clock starts before the request to the database, so that
    a lease ends here before it ends there. An edge that was paused, or cannot reach the database, stops deciding by
    itself.

    Args:
        address: where clients reach this edge.
        term_s: seconds that a lease lasts without renewal.
        on_round: called on the event loop after each renewal, with the missions that other edges have taken over, and
            the IDs of all stored missions that no other edge owns, and whether the database has started anew.

    Attributes:
        shared: whether other edges may own missions of the store.
    """

    shared = True

    def __init__(
        self,
        leases: Leases,
        address: str,
        term_s: float,
        metrics: Metrics,
        on_round: Callable[[set[str], list[str], bool], None],
    ) -> None:
        self._leases = leases
        self._address = address
        self._term_s = term_s
        self._metrics = metrics
        self._on_round = on_round
        self._leased: dict[str, _Lease] = {}
        self._renewed_at = time.monotonic()
        self._failure: str | None = None
        self._loop = asyncio.get_running_loop()
        self._started = leases.started()
        self._ending = threading.Event()
        # A daemon: the end of the edge does not wait for a hanging database.
        threading.Thread(target=self._keep_renewing, name="leases", daemon=True).start()

    @property
    def intact(self) -> bool:
        """Whether the database was reached within the last term; otherwise every lease has ended."""
        return time.monotonic() < self._renewed_at + self._term_s

    def owns(self, mission_id: str) -> bool:
        """Whether this edge has the mission's lease now."""
        lease = self._leased.get(mission_id)
        return lease is not None and time.monotonic() < lease.until

    def epoch(self, mission_id: str) -> int:
        """The epoch of this edge's lease, even if it has ended; 0 without one."""
        lease = self._leased.get(mission_id)
        return 0 if lease is None else lease.epoch

    def claim(self, mission_id: str) -> int:
        """Take the mission's lease if it is free; returns its epoch. It waits for the database.

        Raises:
            Misdirected: another edge has it.
            sqlalchemy.exc.SQLAlchemyError: the database fails.
        """
        asked_at = time.monotonic()
        answer = self._leases.acquire(mission_id, self._address, self._term_s, self.epoch(mission_id) or 1)
        if isinstance(answer, LeaseHolder):
            self._leased.pop(mission_id, None)
            raise _misdirected(mission_id, answer)
        lease = self._leased.get(mission_id)
        if answer > 1 and (lease is None or lease.epoch != answer):
            self._metrics.leases_taken_over.inc()
            log.info("mission %s is taken over, epoch %d", mission_id, answer)
        self._leased[mission_id] = _Lease(answer, asked_at + self._term_s)
        return answer

    def check_free(self, mission_id: str) -> None:
        """Raises as :meth:`claim`, and takes no lease: the owner may not have stored its new mission yet."""
        if (owner := self._leases.owner(mission_id)) is not None:
            raise _misdirected(mission_id, owner)

    def forget(self, mission_id: str) -> None:
        """Drop the lease of a mission that is deleted or taken over."""
        self._leased.pop(mission_id, None)

    def close(self) -> None:
        """End all leases, so that another edge need not wait for their terms. It waits for the database."""
        self._ending.set()
        self._leased.clear()
        if self._failure is not None:
            return
        try:
            self._leases.release()
        except SQLAlchemyError as error:
            log.warning("the leases could not be released, and end by themselves: %s", cause(error))

    def _keep_renewing(self) -> None:
        rounds = _ROUNDS
        while not self._ending.wait(self._term_s / rounds):
            try:
                self._renew()
                rounds = _ROUNDS
            except SQLAlchemyError as error:
                rounds = _ROUNDS_FAILING
                self._fail(cause(error))

    def _renew(self) -> None:
        leases, asked_at = dict(self._leased), time.monotonic()
        renewed = self._leases.renew(self._term_s)
        for mission_id, lease in leases.items():
            # The next request for the mission of an ended lease takes it again, unless another edge has it by then.
            lease.until = asked_at + self._term_s if renewed.get(mission_id) == lease.epoch else 0.0
        ended = {(mission_id, lease.epoch) for mission_id, lease in leases.items() if not lease.until}
        lost = self._leases.lost(ended) if ended else set[tuple[str, int]]()
        # A lease that a request has taken again meanwhile is not lost.
        taken = {mission_id for mission_id, _ in lost if self._leased.get(mission_id) is leases[mission_id]}
        unowned, before, self._started = self._leases.unowned(), self._started, self._leases.started()
        self._renewed_at = asked_at
        if self._failure is not None:
            log.warning("the leases are renewed again")
            self._failure = None
        self._metrics.leases.set(len(leases) - len(ended))
        # The event loop is closed if the edge has ended meanwhile.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._on_round, taken, unowned, before != self._started)

    def _fail(self, failure: str) -> None:
        if failure != self._failure:
            log.error("the leases cannot be renewed, decisions end with their terms: %s", failure)
        self._failure = failure
        self._metrics.store_failures.inc()


def _misdirected(mission_id: str, owner: LeaseHolder) -> Misdirected:
    detail = f"another edge has mission {mission_id}: send the request there"
    return Misdirected("mission_id", detail, owner.address or None, owner.left_s)
