"""Synthetic results for tests, with given numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from lab.experiments.result import Curve, Figure, Interval, Result

CURVES = ["lost_packets_per_step", "lost_packets_cumulative", "events_per_step", "events_cumulative"]


def interval(mean: float, seeds: int = 30, spread: float = 0.0) -> Interval:
    """``seeds`` values around ``mean`` with the same noise for the same seeds: pairs differ only in their means."""
    values = mean + spread * np.random.default_rng(0).standard_normal(seeds)
    middle = float(values.mean())
    return Interval(mean=middle, low=middle - spread, high=middle + spread, values=values.tolist())


def curve(means: Sequence[float]) -> Curve:
    """A band of a fifth around the means."""
    return Curve(mean=list(means), low=[0.8 * m for m in means], high=[1.2 * m for m in means])


def zero_from(step: int, before: float = 2.0, steps: int = 30) -> dict[str, Curve]:
    """Both losses at ``before`` a step until ``step``, and zero from there on."""
    means = [before if at < step else 0.0 for at in range(steps)]
    return {name: curve(np.cumsum(means).tolist() if "cumulative" in name else means) for name in CURVES}


def result(experiment: str, schemes: Mapping[str, Mapping[str, Interval | float]], **changes: Any) -> Result:
    """A full run of 30 seeds in the paper's world; plain numbers become intervals of that mean."""
    whole: dict[str, Any] = {
        "experiment": experiment,
        "title": f"The {experiment} experiment",
        "command": f"python -m lab experiment {experiment} --llm none",
        "version": "0.1.0",
        "commit": "0123456789abcdef",
        "created_at": datetime(2026, 1, 2, tzinfo=UTC),
        "quick": False,
        "scenario": "paper",
        "seeds": list(range(30)),
        "model": "tiny.gguf",
        "schemes": {
            name: {m: found if isinstance(found, Interval) else interval(found) for m, found in measures.items()}
            for name, measures in schemes.items()
        },
    }
    return Result.model_validate({**whole, **changes})


def figure(kind: str, *measures: str, name: str = "drawn") -> Figure:
    """One figure of those measures."""
    return Figure.model_validate({"name": name, "kind": kind, "measures": measures, "caption": "What it shows."})
