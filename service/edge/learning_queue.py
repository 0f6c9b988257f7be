"""The queue of training samples from applied outcomes."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from typing import NamedTuple

from service.learning.modules import Sample
from service.mission.mission import Mission
from service.observability.metrics import Metrics

log = logging.getLogger(__name__)

# Training tasks that may wait, a fraction of a millisecond each.
_MAX_TASKS = 256
# Seconds between two warnings about skipped outcomes.
_WARNING_S = 10.0


class TrainingTask(NamedTuple):
    """A training sample for a mission's modules, and the cost of its outcome."""

    mission: Mission
    sample: Sample
    cost: float


class LearningQueue:
    """Trains on the event loop, a few tasks in each iteration, in the order of the outcomes.

    A thread would hold the interpreter just as long, and switching to it costs extra. The fixed order makes training
    reproducible for a fleet that is flown again.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._waiting = deque[TrainingTask]()
        self._skipped, self._next_warning_at = 0, -math.inf

    @property
    def full(self) -> bool:
        """Whether the queue takes no more tasks."""
        return len(self._waiting) >= _MAX_TASKS

    def add(self, task: TrainingTask) -> None:
        """Train two iterations of the event loop later, after the current decision's request to the LLM or the disk."""
        if not self._waiting:
            self._loop.call_soon(self._loop.call_soon, self._train_some)
        self._waiting.append(task)

    def _train_some(self) -> None:
        """Train on one task and a quarter of the rest: no request waits long, and the queue keeps up with the arrivals.

        In an iteration in which 64 UAVs send requests, 64 outcomes may arrive.
        """
        for _ in range(min(len(self._waiting), 1 + len(self._waiting) // 4)):
            self._train(self._waiting.popleft())
        if self._waiting:
            self._loop.call_soon(self._train_some)

    def skip(self) -> None:
        """Count an outcome that is not used for training; under overload hundreds a second share one warning."""
        self._skipped += 1
        if (now := time.monotonic()) >= self._next_warning_at:
            log.warning("learning falls behind: %d outcomes are not used for training", self._skipped)
            self._skipped, self._next_warning_at = 0, now + _WARNING_S

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
