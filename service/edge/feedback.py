"""Outcomes of decisions: applied once, used for training between decisions, and included in checkpoints."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress
from typing import Literal

from service.edge.learning_queue import LearningQueue, TrainingTask
from service.errors import Conflict
from service.live.broadcaster import Broadcaster
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from shared.wire import Outcome

log = logging.getLogger(__name__)


class Feedback:
    """Applies each outcome once, and checkpoints missions with their training."""

    def __init__(self, metrics: Metrics, journal: Journal | NullJournal, live: Broadcaster) -> None:
        self._metrics = metrics
        self._journal = journal
        self._live = live
        self._training = LearningQueue(metrics)

    def apply(self, mission: Mission, outcome: Outcome) -> Literal["applied", "duplicate"]:
        """Apply an outcome, unless it is applied already; raises as :meth:`PendingDecisions.find`."""
        result: Literal["applied", "duplicate"] = "duplicate"
        try:
            found = mission.pending.find(outcome)
        except Conflict as error:
            self._metrics.feedback.labels("contradicted").inc()
            log.warning("mission %s: outcome dropped: %s", mission.mission_id, error)
            raise
        if found == "pending":
            result = "applied"
            if outcome.cost > mission.pending.max_step_cost:
                # The limit keeps a forged or wrong cost from harming the modules and the prompt.
                self._metrics.costs_clipped.inc()
                outcome = outcome.model_copy(update={"cost": mission.pending.max_step_cost})
            for_training = not self._training.full
            sample = mission.apply(outcome, for_training=for_training)
            self._live.outcome_applied(mission, outcome)
            if sample is not None and for_training:
                self._training.add(TrainingTask(mission, sample, outcome.cost))
            elif sample is not None:
                self._training.skip()
        self._metrics.feedback.labels(result).inc()
        return result

    def apply_reported(self, mission: Mission, outcome: Outcome) -> None:
        """Apply an outcome that comes with a report; one that contradicts an applied outcome is dropped.

        Any key can read decision IDs and forge an outcome, and the true UAV still needs its next decision.

        Raises:
            NotFound: the mission does not know the decision.
        """
        with suppress(Conflict):
            self.apply(mission, outcome)

    def checkpoint(self, mission: Mission, least: int | None = None) -> None:
        """Write a checkpoint of the mission, after all waiting training, where one is due.

        Args:
            least: events since the last checkpoint that make one due; by default the journal's number.
        """
        if not isinstance(self._journal, Journal):
            return
        mission_log = self._journal.due(mission) if least is None else self._journal.due(mission, least)
        if mission_log is None:
            return
        self._training.catch_up(mission)
        self._journal.checkpoint(mission_log, {**mission.state_dict(), "learner": mission.learner.state_dict()})

    def finish(self) -> None:
        """Finish all waiting training now."""
        self._training.finish()

    async def close(self, missions: list[Mission], within_s: float) -> None:
        """Write a checkpoint of every mission while there is time; the journal has the events of the others."""
        ends = time.monotonic() + within_s
        for mission in missions:
            if time.monotonic() >= ends:
                break
            self.checkpoint(mission, 1)
            # Open requests and the journal continue between two checkpoints.
            await asyncio.sleep(0)
