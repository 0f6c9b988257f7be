"""The outcomes that are still to be learned from."""

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

# Outcomes waiting to be learned from, a fraction of a millisecond each.
_MAX_LESSONS = 256
_TELL_S = 10.0


class Lesson(NamedTuple):
    """What a mission's modules are to learn: that what they saw came to this cost."""

    mission: Mission
    sample: Sample
    cost: float


class LearningQueue:
    """Learns on the event loop, a few lessons a turn of it, in the order that the outcomes came.

    A thread's lesson would take the interpreter from the decisions just as long, and the thread must be woken besides;
    and a fleet that is flown again in the same order learns the same.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._waiting = deque[Lesson]()
        self._missed, self._tell_at = 0, -math.inf

    @property
    def full(self) -> bool:
        """Whether what comes now is not learned from."""
        return len(self._waiting) >= _MAX_LESSONS

    def add(self, lesson: Lesson) -> None:
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

    def miss(self) -> None:
        """One line now and then: where learning falls behind, hundreds of outcomes a second are not learned from."""
        self._missed += 1
        if (now := time.monotonic()) >= self._tell_at:
            log.warning("learning falls behind: %d outcomes are not learned from", self._missed)
            self._missed, self._tell_at = 0, now + _TELL_S

    def catch_up(self, mission: Mission) -> None:
        """Learn what waits of one mission, now."""
        waiting, self._waiting = self._waiting, deque()
        for lesson in waiting:
            if lesson.mission is mission:
                self._learn(lesson)
            else:
                self._waiting.append(lesson)

    def finish(self) -> None:
        """Learn what waits, now."""
        while self._waiting:
            self._learn(self._waiting.popleft())

    def _learn(self, lesson: Lesson) -> None:
        if (loss := lesson.mission.learn(lesson.sample, lesson.cost)) is not None:
            self._metrics.learner_loss.set(loss)
            self._metrics.learner_update_loss.observe(loss)
