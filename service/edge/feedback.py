"""What came of decisions: recorded once, learned from between the decisions, and checkpointed with what was learned."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from contextlib import suppress
from typing import Literal, NamedTuple

from service.errors import Conflict
from service.learning.sample import Sample
from service.live.broadcaster import Broadcaster
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from shared.wire import Outcome

log = logging.getLogger(__name__)

# Outcomes waiting to be learned from, a fraction of a millisecond each.
_MAX_LESSONS = 256
_TELL_S = 10.0


class Lesson(NamedTuple):
    """What a mission's modules are to learn: that what they saw came to this cost."""

    mission: Mission
    sample: Sample
    cost: float


class Outcomes:
    """Learns on the event loop, a few lessons a turn of it, in the order that the outcomes came.

    A thread's lesson would take the interpreter from the decisions just as long, and the thread must be woken besides;
    and a fleet that is flown again in the same order learns the same.
    """

    def __init__(self, metrics: Metrics, keeper: Journal | NullJournal, live: Broadcaster) -> None:
        self._metrics = metrics
        self._live = live
        self._keeper = keeper
        self._loop = asyncio.get_running_loop()
        self._waiting = deque[Lesson]()
        self._missed, self._tell_at = 0, -math.inf

    def apply(self, mission: Mission, outcome: Outcome) -> Literal["applied", "duplicate"]:
        """Record an outcome, unless it is recorded already; raises as :meth:`Mission.find`."""
        result: Literal["applied", "duplicate"] = "duplicate"
        try:
            found = mission.find(outcome)
        except Conflict as error:
            self._metrics.feedback.labels("contradicted").inc()
            log.warning("mission %s: dropped: %s", mission.mission_id, error)
            raise
        if found == "pending":
            result = "applied"
            if outcome.cost > mission.most_cost:
                # Forged or mistaken: as the worst that can be, it spoils neither the modules nor the prompt.
                self._metrics.costs_clipped.inc()
                outcome = outcome.model_copy(update={"cost": mission.most_cost})
            taught = len(self._waiting) < _MAX_LESSONS
            sample = mission.apply(outcome, taught=taught)
            self._live.settled(mission, outcome)
            if sample is not None and taught:
                self._begin(Lesson(mission, sample, outcome.cost))
            elif sample is not None:
                self._miss()
        self._metrics.feedback.labels(result).inc()
        return result

    def take(self, mission: Mission, outcome: Outcome) -> None:
        """As :meth:`apply`, of an outcome that comes with a report: one that contradicts an earlier one is dropped.

        Any key reads decision IDs and may forge the earlier one, and a UAV that tells the truth must get its decision.

        Raises:
            NotFound: the mission does not know the decision.
        """
        with suppress(Conflict):
            self.apply(mission, outcome)

    def _begin(self, lesson: Lesson) -> None:
        """Learn two turns of the loop later: what the decision in hand asks of the LLM or the disk goes out first."""
        if not self._waiting:
            self._loop.call_soon(self._loop.call_soon, self._turn)
        self._waiting.append(lesson)

    def _turn(self) -> None:
        """A lesson, and a quarter of what waits besides: nobody waits for many, and as many are learned as come.

        In a turn of the loop in which 64 UAVs ask, 64 outcomes may come.
        """
        for _ in range(min(len(self._waiting), 1 + len(self._waiting) // 4)):
            self._learn(self._waiting.popleft())
        if self._waiting:
            self._loop.call_soon(self._turn)

    def _miss(self) -> None:
        """One line now and then: where learning falls behind, hundreds of outcomes a second are not learned from."""
        self._missed += 1
        if (now := time.monotonic()) >= self._tell_at:
            log.warning("learning falls behind: %d outcomes are not learned from", self._missed)
            self._missed, self._tell_at = 0, now + _TELL_S

    def checkpoint(self, mission: Mission, least: int | None = None) -> None:
        """Keep the mission's whole state, once what happened until now is learned, where that is due.

        Args:
            least: events since the last checkpoint that make one due; the journal's own number unless given.
        """
        if not isinstance(self._keeper, Journal):
            return
        mission_log = self._keeper.due(mission) if least is None else self._keeper.due(mission, least)
        if mission_log is None:
            return
        waiting, self._waiting = self._waiting, deque()
        for lesson in waiting:
            if lesson.mission is mission:
                self._learn(lesson)
            else:
                self._waiting.append(lesson)
        self._keeper.checkpoint(mission_log, {**mission.state_dict(), "learner": mission.learner.state_dict()})

    def finish(self) -> None:
        """Learn what waits, now."""
        while self._waiting:
            self._learn(self._waiting.popleft())

    async def close(self, missions: list[Mission], within_s: float) -> None:
        """Checkpoint every mission, as far as there is time; the journal has the rest."""
        ends = time.monotonic() + within_s
        for mission in missions:
            if time.monotonic() >= ends:
                break
            self.checkpoint(mission, 1)
            # Who still asks, and the journal, go on between.
            await asyncio.sleep(0)

    def _learn(self, lesson: Lesson) -> None:
        if (loss := lesson.mission.learn(lesson.sample, lesson.cost)) is not None:
            self._metrics.learner_loss.set(loss)
            self._metrics.learner_update_loss.observe(loss)
