"""One UAV's turn to be told, and what is chosen for it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from service.deciding.llm_query import LlmAdvice
from service.learning.trust import Advice
from service.llm.completion import Completion
from service.observability.stopwatch import Stopwatch
from shared.wire import Guided, Reason, Source, UavState

_SOURCES: dict[Reason | None, Source] = {None: "llm", "mode_value": "value", "mode_policy": "policy"}
# Kept back from the LLM's time for checking, answering and the way through the event loop.
RESERVE_S = 0.02


@dataclass(frozen=True, slots=True)
class DecisionTask:
    """One UAV's turn to be told: its attempt at this step, its time, and what has been begun for it.

    ``word`` is there where the LLM has been asked about it already; ``latest`` where others of its batch can wait for
    it past its own share, of ``time.perf_counter``.
    """

    uav: UavState
    step: int
    attempt: int
    deadline_ms: int
    watch: Stopwatch
    plan: asyncio.Task[None] | None
    word: LlmAdvice | None = None
    latest: float = 0.0

    @property
    def deadline(self) -> float:
        """When to have checked and answered, of ``time.perf_counter``."""
        return self.watch.started + self.deadline_ms / 1e3 - RESERVE_S

    @property
    def last_moment(self) -> float:
        """When to weigh no longer, and go by the policy."""
        return max(self.deadline, self.latest)


@dataclass(frozen=True, slots=True)
class Choice:
    """A sensor and a velocity, with the reason where the LLM had no part in them.

    In mode ``guided`` also what the response tells of it, and the advice that trust learns from.
    """

    sensor_id: int
    velocity: int
    reason: Reason | None
    completion: Completion | None
    model: str | None
    guided: Guided | None = None
    advice: Advice | None = None

    @property
    def source(self) -> Source:
        """Who decided."""
        return "guided" if self.guided and self.reason is None else _SOURCES.get(self.reason, "policy")
