"""The estimate of a run's remaining time, from the durations of earlier flights of the same kind."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from lab.experiments.plan import Planned
from lab.experiments.schemes import Clairvoyant, Informed, Local

# Seconds a decision on two cores, for kinds of flights not measured yet.
_LOCAL_S, _PLANNER_S, _BOUND_S, _EDGE_S, _LLM_S = 0.001, 0.2, 0.05, 0.015, 0.75


class Pace:
    """Seconds a decision by kind of flight, updated with every flight."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._decisions: defaultdict[str, int] = defaultdict(int)

    def took(self, planned: Planned, seconds: float) -> None:
        """Record the duration of a flight."""
        self._seconds[_kind(planned)] += seconds
        self._decisions[_kind(planned)] += _decisions(planned)

    def left_s(self, planned: Iterable[Planned]) -> float:
        """The estimated seconds of these flights, one after another."""
        return sum(self._seconds_of(flight) for flight in planned)

    def _seconds_of(self, planned: Planned) -> float:
        kind = _kind(planned)
        if self._decisions[kind]:
            return self._seconds[kind] / self._decisions[kind] * _decisions(planned)
        return _guess(planned) * _decisions(planned)


def duration_text(seconds: float) -> str:
    """A duration in words: ``40 s``, ``12 min``, ``3 h 20 min``."""
    if seconds < 90:
        return f"{max(0, round(seconds)):d} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _decisions(planned: Planned) -> int:
    return planned.site.scenario.steps * planned.site.scenario.uavs


def _kind(planned: Planned) -> str:
    decides = planned.scheme.decides
    decider = decides.policy if isinstance(decides, Local) else f"{decides.kind} {planned.backing}"
    # More sensors make a longer prompt and a larger plan.
    return f"{decider} {planned.site.scenario.sensors}"


def _guess(planned: Planned) -> float:
    decides = planned.scheme.decides
    if isinstance(decides, Clairvoyant):
        return _BOUND_S
    if isinstance(decides, Local | Informed):
        return _PLANNER_S if planned.plans else _LOCAL_S
    return _LLM_S if planned.scheme.asks_llm else _EDGE_S
