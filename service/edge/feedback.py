"""What came of decisions: recorded once, learned from between the decisions, and checkpointed with what was learned."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress
from typing import Literal

from service.edge.learning_queue import LearningQueue, Lesson
from service.errors import Conflict
from service.live.broadcaster import Broadcaster
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from shared.wire import Outcome

log = logging.getLogger(__name__)


class Feedback:
    """Applies outcomes, each once, and checkpoints what was learned of them."""

    def __init__(self, metrics: Metrics, journal: Journal | NullJournal, live: Broadcaster) -> None:
        self._metrics = metrics
        self._journal = journal
        self._live = live
        self._lessons = LearningQueue(metrics)

    def apply(self, mission: Mission, outcome: Outcome) -> Literal["applied", "duplicate"]:
        """Record an outcome, unless it is recorded already; raises as :meth:`Mission.find`."""
        result: Literal["applied", "duplicate"] = "duplicate"
        try:
            found = mission.pending.find(outcome)
        except Conflict as error:
            self._metrics.feedback.labels("contradicted").inc()
            log.warning("mission %s: dropped: %s", mission.mission_id, error)
            raise
        if found == "pending":
            result = "applied"
            if outcome.cost > mission.pending.max_step_cost:
                # Forged or mistaken: as the worst that can be, it spoils neither the modules nor the prompt.
                self._metrics.costs_clipped.inc()
                outcome = outcome.model_copy(update={"cost": mission.pending.max_step_cost})
            taught = not self._lessons.full
            sample = mission.apply(outcome, for_training=taught)
            self._live.outcome_applied(mission, outcome)
            if sample is not None and taught:
                self._lessons.add(Lesson(mission, sample, outcome.cost))
            elif sample is not None:
                self._lessons.miss()
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

    def checkpoint(self, mission: Mission, least: int | None = None) -> None:
        """Keep the mission's whole state, once what happened until now is learned, where that is due.

        Args:
            least: events since the last checkpoint that make one due; the journal's own number unless given.
        """
        if not isinstance(self._journal, Journal):
            return
        mission_log = self._journal.due(mission) if least is None else self._journal.due(mission, least)
        if mission_log is None:
            return
        self._lessons.catch_up(mission)
        self._journal.checkpoint(mission_log, {**mission.state_dict(), "learner": mission.learner.state_dict()})

    def finish(self) -> None:
        """Learn what waits, now."""
        self._lessons.finish()

    async def close(self, missions: list[Mission], within_s: float) -> None:
        """Checkpoint every mission, as far as there is time; the journal has the rest."""
        ends = time.monotonic() + within_s
        for mission in missions:
            if time.monotonic() >= ends:
                break
            self.checkpoint(mission, 1)
            # Who still asks, and the journal, go on between.
            await asyncio.sleep(0)
