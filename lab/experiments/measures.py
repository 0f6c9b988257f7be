"""Measures of a flight: one number a mission, or one a step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from lab.experiments.flight import DecisionRecord, FlightRecord, TokenCounts
from shared.planning.orders import count_deadlines
from simulator.records.decision import jain_index

# Prefixes of the reasons of decisions taken because the LLM gave none. `no_candidate` is none of them, since the LLM
# had no question to answer.
_SUBSTITUTED = ("llm_", "answer_", "edge_", "critic_")


@dataclass(frozen=True)
class Measure:
    """One number of a flight, ``None`` if undefined; ``label`` has the unit."""

    label: str
    of: Callable[[FlightRecord], float | None]


@dataclass(frozen=True)
class StepMeasure:
    """One number a step of a flight, ``None`` if undefined; ``label`` has the unit."""

    label: str
    of: Callable[[FlightRecord], list[float] | None]


def ages(flight: FlightRecord) -> np.ndarray:
    """Age of information at the end of each step, shape ``(T, J)``, in steps.

    ``A_j(t) = 1`` if sensor j was served in step t, else ``A_j(t-1) + 1``, with ``A_j(-1) = 0``: all information is
    fresh at take-off, and information collected in a step is one step old at its end. Served means f = 0, an empty
    queue included.
    """
    served = np.zeros((flight.steps, flight.sensors), dtype=bool)
    for decision in flight.decisions:
        if not decision.failed:
            served[decision.step, decision.sensor] = True
    age = np.zeros((flight.steps, flight.sensors))
    before = np.zeros(flight.sensors)
    for step in range(flight.steps):
        before = np.where(served[step], 1.0, before + 1.0)
        age[step] = before
    return age


def events_per_step(flight: FlightRecord) -> list[float]:
    """The paper's loss P_l: failed transmissions plus overflowing sensors, a step."""
    return [float(f + g) for f, g in zip(flight.failures, flight.overflows, strict=True)]


def substituted_decisions(flight: FlightRecord) -> int:
    """The number of decisions that the policy or the UAV took in place of the LLM."""
    return sum(d.reason is not None and d.reason.startswith(_SUBSTITUTED) for d in flight.decisions)


def _jain(flight: FlightRecord, counts: Callable[[DecisionRecord], bool]) -> float | None:
    visits = [d.sensor for d in flight.decisions if counts(d)]
    return jain_index(np.bincount(visits, minlength=flight.sensors).tolist())


def _mean(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if present else None


def _deadlines_met(flight: FlightRecord) -> float | None:
    """The percentage of the requested visits' deadlines that were met: :mod:`shared.planning.orders`."""
    met = total = 0
    for request in flight.meant.sensors if flight.meant is not None else []:
        if request.visit_every is not None:
            served = {d.step for d in flight.decisions if d.sensor == request.sensor_id and not d.failed}
            kept, missed = count_deadlines(request.visit_every, 0, flight.steps - 1, served)
            met, total = met + kept, total + kept + missed
    return 100 * met / total if total else None


def _velocities_allowed(flight: FlightRecord) -> float | None:
    if flight.meant is None or not flight.decisions:
        return None
    return 100 * sum(flight.meant.allows(d.velocity) for d in flight.decisions) / len(flight.decisions)


def _confirmed(flight: FlightRecord) -> float | None:
    return None if flight.guidance is None else 100.0 * (flight.guidance == "confirmed")


def _tokens(field: Callable[[TokenCounts], float | None]) -> Callable[[FlightRecord], float | None]:
    return lambda flight: _mean(field(d.tokens) for d in flight.decisions if d.tokens is not None)


def _saved_pct(
    sent: Callable[[TokenCounts], int], whole: Callable[[TokenCounts], int]
) -> Callable[[FlightRecord], float | None]:
    def saved(flight: FlightRecord) -> float | None:
        counts = [d.tokens for d in flight.decisions if d.tokens is not None]
        total = sum(map(whole, counts))
        return 100 * (1 - sum(map(sent, counts)) / total) if total else None

    return saved


def _trip(q: float) -> Callable[[FlightRecord], float | None]:
    def percentile(flight: FlightRecord) -> float | None:
        trips = [d.rtt_ms for d in flight.decisions if d.rtt_ms is not None]
        return float(np.percentile(trips, q)) if trips else None

    return percentile


def _share(time_ms: Callable[[DecisionRecord], float]) -> Callable[[FlightRecord], float | None]:
    """A time in percent of the mission's round-trip time."""

    def share(flight: FlightRecord) -> float | None:
        timed = [d for d in flight.decisions if d.rtt_ms is not None]
        whole = sum(d.rtt_ms or 0.0 for d in timed)
        return 100 * sum(map(time_ms, timed)) / whole if whole else None

    return share


def _stage(name: str) -> Measure:
    return Measure(f"{name}, % of the round trip", _share(lambda d: d.latency_ms.get(name, 0.0)))


def _trips_per_step(flight: FlightRecord) -> list[float] | None:
    by_step = [
        _mean(d.rtt_ms for d in flight.decisions if d.step == step and d.rtt_ms is not None)
        for step in range(flight.steps)
    ]
    present = [mean for mean in by_step if mean is not None]
    return present if len(present) == flight.steps else None


def _last_trust(adviser: str) -> Callable[[FlightRecord], float | None]:
    """An adviser's mean weight before the last decisions in which it had one, up to one a UAV."""

    def last(flight: FlightRecord) -> float | None:
        weights = [d.trust[adviser] for d in flight.decisions if adviser in d.trust]
        return _mean(weights[-flight.uavs :])

    return last


def _counted(steps: list[int]) -> list[float] | None:
    return [float(value) for value in steps] or None


MEASURES: dict[str, Measure] = {
    "lost_packets": Measure("lost packets", lambda f: float(sum(f.lost_packets))),
    "events": Measure("loss events", lambda f: sum(events_per_step(f))),
    "failures": Measure("failed transmissions", lambda f: float(sum(f.failures))),
    "overflows": Measure("overflows", lambda f: float(sum(f.overflows))),
    "collected": Measure("packets collected", lambda f: float(sum(d.collected for d in f.decisions))),
    "velocity": Measure("mean velocity, m/s", lambda f: _mean(float(d.velocity) for d in f.decisions)),
    "jain": Measure("Jain's index of served visits", lambda f: _jain(f, lambda d: not d.failed)),
    "jain_scheduled": Measure("Jain's index of scheduled visits", lambda f: _jain(f, lambda d: True)),
    "aoi_mean": Measure("mean age of information, steps", lambda f: float(ages(f).mean())),
    "aoi_peak": Measure("peak age of information, mean over sensors, steps", lambda f: float(ages(f).max(0).mean())),
    "aoi_worst": Measure("peak age of information, worst sensor, steps", lambda f: float(ages(f).max())),
    "state_tokens": Measure("state block, tokens", _tokens(lambda t: t.state)),
    "state_uncompressed": Measure("state block without attention, tokens", _tokens(lambda t: t.state_uncompressed)),
    "state_saved_pct": Measure("state block saved, %", _saved_pct(lambda t: t.state, lambda t: t.state_uncompressed)),
    "prompt_tokens": Measure("prompt, tokens", _tokens(lambda t: t.prompt)),
    "prompt_uncompressed": Measure("prompt without attention, tokens", _tokens(lambda t: t.uncompressed)),
    "prompt_saved_pct": Measure("prompt saved, %", _saved_pct(lambda t: t.prompt, lambda t: t.uncompressed)),
    "cached_tokens": Measure("prompt from the prefix cache, model's tokens", _tokens(lambda t: t.cached)),
    "completion_tokens": Measure("completion, model's tokens", _tokens(lambda t: t.completion)),
    "rtt_p50": Measure("round trip, median, ms", _trip(50)),
    "rtt_p90": Measure("round trip, 90th percentile, ms", _trip(90)),
    "rtt_p99": Measure("round trip, 99th percentile, ms", _trip(99)),
    **{f"share_{name}": _stage(name) for name in ("augment", "attend", "prompt", "llm", "check")},
    "share_network": Measure(
        "HTTP and network, % of the round trip", _share(lambda d: (d.rtt_ms or 0.0) - d.latency_ms.get("total", 0.0))
    ),
    "deadlines_met_pct": Measure("visit deadlines met, %", _deadlines_met),
    "velocities_allowed_pct": Measure("steps at allowed velocities, %", _velocities_allowed),
    "guidance_confirmed_pct": Measure("guidance confirmed, %", _confirmed),
    "llm_decided_pct": Measure(
        "decided by the LLM, %", lambda f: 100 * sum(d.source == "llm" for d in f.decisions) / len(f.decisions)
    ),
    "llm_trust": Measure("the LLM's weight among the advisers at the end", _last_trust("llm")),
}

STEP_MEASURES: dict[str, StepMeasure] = {
    "lost_packets_per_step": StepMeasure("lost packets a step", lambda f: _counted(f.lost_packets)),
    "lost_packets_cumulative": StepMeasure("lost packets so far", lambda f: _counted(list(accumulate(f.lost_packets)))),
    "events_per_step": StepMeasure("loss events a step", events_per_step),
    "events_cumulative": StepMeasure("loss events so far", lambda f: list(accumulate(events_per_step(f)))),
    "rtt_ms_per_step": StepMeasure("round trip, mean of the UAVs, ms", _trips_per_step),
    "aoi_per_step": StepMeasure("age of information, mean of the sensors, steps", lambda f: ages(f).mean(1).tolist()),
}
LOSSES = ("lost_packets", "events")
LOSS_CURVES = ("lost_packets_per_step", "lost_packets_cumulative", "events_per_step", "events_cumulative")
