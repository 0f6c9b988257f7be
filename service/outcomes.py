"""What came of decisions: recorded once, learned from beside the decisions, and checkpointed with what was learned."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Literal

from service.gradient import Sample
from service.journal import Journal, Unkept
from service.live.watch import Live
from service.metrics import Metrics
from service.mission import Mission
from shared.wire import Outcome

log = logging.getLogger(__name__)

# Outcomes waiting to be learned from, a fraction of a millisecond each.
_MAX_LESSONS = 256
_TELL_S = 10.0


class Outcomes:
    """One thread learns, in the order that the outcomes came, for every mission of a service.

    Belongs to the event loop that it is made on.
    """

    def __init__(self, metrics: Metrics, keeper: Journal | Unkept, live: Live) -> None:
        self._metrics = metrics
        self._live = live
        self._keeper = keeper
        self._learning = ThreadPoolExecutor(max_workers=1, thread_name_prefix="learner")
        self._loop = asyncio.get_running_loop()
        self._begun: list[Callable[[], None]] = []
        self._room = threading.Semaphore(_MAX_LESSONS)
        self._missed, self._tell_at = 0, -math.inf

    def apply(self, mission: Mission, outcome: Outcome) -> Literal["applied", "duplicate"]:
        """Record an outcome, unless it is recorded already; raises as :meth:`Mission.find`."""
        result: Literal["applied", "duplicate"] = "duplicate"
        if mission.find(outcome) == "pending":
            result = "applied"
            if outcome.cost > mission.most_cost:
                # Forged or mistaken: as the worst that can be, it spoils neither the modules nor the prompt.
                self._metrics.costs_clipped.inc()
                outcome = outcome.model_copy(update={"cost": mission.most_cost})
            taught = self._room.acquire(blocking=False)
            sample = mission.apply(outcome, taught=taught)
            self._live.settled(mission, outcome)
            if sample is not None and taught:
                self._begin(partial(self._learn, mission, sample, outcome.cost))
            elif taught:
                self._room.release()
            elif sample is not None:
                self._miss()
        self._metrics.feedback.labels(result).inc()
        return result

    def _begin(self, lesson: Callable[[], None]) -> None:
        """Learn once the decision in hand waits for something: until then it needs the interpreter itself."""
        if not self._begun:
            self._loop.call_soon(self._hand_over)
        self._begun.append(lesson)

    def _hand_over(self) -> None:
        for lesson in self._begun:
            self._learning.submit(lesson)
        self._begun.clear()

    def _miss(self) -> None:
        """One line now and then: where learning falls behind, hundreds of outcomes a second are not learned from."""
        self._missed += 1
        if (now := time.monotonic()) >= self._tell_at:
            log.warning("learning falls behind: %d outcomes are not learned from", self._missed)
            self._missed, self._tell_at = 0, now + _TELL_S

    def checkpoint(self, mission: Mission, least: int | None = None) -> Future[None] | None:
        """Begin to keep the mission's whole state, once what happened until now is learned; None where none is due.

        Args:
            least: events since the last checkpoint that make one due; the journal's own number unless given.
        """
        if not isinstance(self._keeper, Journal):
            return None
        track = self._keeper.due(mission) if least is None else self._keeper.due(mission, least)
        if track is None:
            return None
        self._hand_over()
        keeper, seq, state = self._keeper, track.seq, mission.state_dict()
        return self._learning.submit(
            lambda: keeper.checkpoint(track, seq, {**state, "learner": mission.learner.state_dict()})
        )

    def close(self, missions: list[Mission], within_s: float) -> None:
        """Checkpoint every mission after the lessons in hand, as far as there is time; the journal has the rest."""
        self._hand_over()
        begun = [taken for mission in missions if (taken := self.checkpoint(mission, 1)) is not None]
        wait(begun, timeout=within_s)
        self._learning.shutdown(wait=True, cancel_futures=True)

    def _learn(self, mission: Mission, sample: Sample, cost: float) -> None:
        try:
            loss = learn(mission, sample, cost)
            if loss is not None:
                self._metrics.learner_loss.set(loss)
                self._metrics.learner_update_loss.observe(loss)
        finally:
            self._room.release()


def learn(mission: Mission, sample: Sample, cost: float) -> float | None:
    """One lesson, and the loss before it; one that fails is told and left out: None."""
    try:
        return mission.learner.update(sample, cost)
    except Exception:
        log.exception("mission %s: the learner failed on an outcome; decisions go on", mission.mission_id)
        return None
