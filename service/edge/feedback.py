"""Outcomes of decisions: applied once, used for training between decisions, and included in checkpoints."""

import asyncio
import logging
import math
import time
from collections import deque
from contextlib import suppress
from typing import Literal, NamedTuple

from service.errors import Conflict
from service.learning.modules import Sample
from service.live.broadcaster import Broadcaster
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from shared.wire.schemas import Outcome

log = logging.getLogger(__name__)


# Training tasks that may wait, a fraction of a millisecond each.
MAX_TASKS = 256
# Seconds between two warnings about skipped outcomes.
WARNING_S = 10.0


class Feedback:
    """Applies each outcome once, and checkpoints missions with their training."""

    def __init__(self, metrics: Metrics, journal: Journal | NullJournal, live: Broadcaster) -> None:
        self._metrics = metrics
        self._journal = journal
        self._live = live
        self._training = LearningQueue(metrics)
        # Applied outcomes that are not on the mission page yet.
        self._unpublished: list[tuple[Mission, Outcome]] = []

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
            self._unpublished.append((mission, outcome))
            if sample is not None and for_training:
                self._training.add(TrainingTask(mission, sample, outcome.cost))
            elif sample is not None:
                self._training.skip()
        self._metrics.feedback.labels(result).inc()
        return result

    def apply_reported(self, mission: Mission, outcome: Outcome) -> None:
        """Apply the outcome in a report; one that contradicts an applied outcome is dropped.

        Any key can read decision IDs and forge an outcome, and the real UAV still needs its next decision.

        Raises:
            NotFound: the mission does not know the decision.
        """
        with suppress(Conflict):
            self.apply(mission, outcome)

    def follow_up(self, mission: Mission) -> None:
        """After an answer: publish applied outcomes on the mission page, and write a checkpoint if one is due."""
        unpublished, self._unpublished = self._unpublished, []
        for owner, outcome in unpublished:
            self._live.outcome_applied(owner, outcome)
        self.checkpoint(mission)

    def checkpoint(self, mission: Mission, least: int | None = None) -> None:
        """Finish the mission's waiting training and write a checkpoint, if one is due.

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

    def catch_up(self, mission: Mission) -> None:
        """Finish the mission's waiting training: a request that comes at once decides as one that comes later."""
        self._training.catch_up(mission)

    def finish(self) -> None:
        """Finish all waiting training now."""
        self._training.finish()

    async def checkpoint_all(self, missions: list[Mission], within_s: float) -> None:
        """Write a checkpoint of every changed mission while there is time; the journal has the others' events."""
        ends = time.monotonic() + within_s
        for mission in missions:
            if time.monotonic() >= ends:
                break
            self.checkpoint(mission, 1)
            # Open requests and the journal continue between two checkpoints.
            await asyncio.sleep(0)


class TrainingTask(NamedTuple):
    """A training sample for a mission's modules, and the cost of its outcome."""

    mission: Mission
    sample: Sample
    cost: float


class LearningQueue:
    """Trains on the event loop, a few tasks in each iteration, in the order of the outcomes.

    A thread would need the interpreter lock just as long, and switching to it costs extra. The fixed order makes
    training reproducible for a fleet that is flown again.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._waiting = deque[TrainingTask]()
        self._skipped, self._next_warning_at = 0, -math.inf

    @property
    def full(self) -> bool:
        """Whether the queue takes no more tasks."""
        return len(self._waiting) >= MAX_TASKS

    def add(self, task: TrainingTask) -> None:
        """Train two iterations of the event loop later, after the current decision's request to the LLM or the disk."""
        if not self._waiting:
            self._loop.call_soon(self._loop.call_soon, self.train_some)
        self._waiting.append(task)

    def train_some(self) -> None:
        """Train on one task and a quarter of the rest: 64 UAVs bring 64 outcomes at once, and no request waits long."""
        for _ in range(min(len(self._waiting), 1 + len(self._waiting) // 4)):
            self._train(self._waiting.popleft())
        if self._waiting:
            self._loop.call_soon(self.train_some)

    def skip(self) -> None:
        """Count an outcome that is not used for training; under overload hundreds a second share one warning."""
        self._skipped += 1
        if (now := time.monotonic()) >= self._next_warning_at:
            log.warning("learning falls behind: %d outcomes are not used for training", self._skipped)
            self._skipped, self._next_warning_at = 0, now + WARNING_S

    def catch_up(self, mission: Mission) -> None:
        """Finish one mission's waiting training now."""
        waiting, self._waiting = self._waiting, deque()
        for task in waiting:
            if task.mission is mission:
                self._train(task)
            else:
                self._waiting.append(task)

    def finish(self) -> None:
        """Finish all waiting training now."""
        while self._waiting:
            self._train(self._waiting.popleft())

    def _train(self, task: TrainingTask) -> None:
        if (loss := task.mission.learn(task.sample, task.cost)) is not None:
            self._metrics.learner_loss.set(loss)
            self._metrics.learner_update_loss.observe(loss)
