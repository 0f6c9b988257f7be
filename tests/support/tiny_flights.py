"""Flights for tests, written by hand or flown by a cheap policy."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from lab.experiments.edges import Llm
from lab.experiments.flight import DecisionRecord, FlightRecord
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.runner import Run
from lab.experiments.schemes import Scheme, local
from shared.world.scenario import Scenario
from simulator.sites.site import Site

TINY = Scenario(steps=3)


def flown(decisions: Sequence[DecisionRecord] = (), **changes: Any) -> FlightRecord:
    """A flight, by default of three steps, two UAVs and three sensors."""
    facts: dict[str, Any] = {
        "seed": 0,
        "scenario": "paper",
        "steps": 3,
        "sensors": 3,
        "uavs": 2,
        "model": None,
        "commit": "abc",
        "flown_at": datetime(2026, 1, 1, tzinfo=UTC),
        "duration_s": 1.0,
        "decisions": list(decisions),
    }
    return FlightRecord(**{**facts, **changes})


def decided(step: int, sensor: int, *, failed: bool = False, uav: int = 0, **changes: Any) -> DecisionRecord:
    """One decision, by default of an edge's policy."""
    facts: dict[str, Any] = {"velocity": 7, "collected": 5, "source": "policy"}
    return DecisionRecord(step=step, uav=uav, sensor=sensor, failed=failed, **{**facts, **changes})


def setup(**changes: Any) -> Setup:
    """Three seeds of three steps, and no LLM."""
    sites = {"paper": Site(TINY)}
    return Setup(**{"sites": sites, "llm": Llm("none"), "seeds": 3, "llm_seeds": 2, **changes})


def declared(*schemes: Scheme, name: str = "tiny", **changes: Any) -> Experiment:
    """An experiment that measures the losses of the given schemes, by default EOF and random."""
    facts: dict[str, Any] = {
        "title": "Tiny",
        "summary": "for tests",
        "schemes": lambda setup: list(schemes) or [local("eof"), local("random")],
        "measures": ("lost_packets", "events", "jain"),
        "figures": (FigureSpec("tiny", "bars", ("lost_packets", "events"), "Losses."),),
        "references": ("eof",),
    }
    return Experiment(name=name, **{**facts, **changes})


def run_in(out: Path, **changes: Any) -> Run:
    """A run of the setup above that writes to ``out`` and prints nothing."""
    return Run(setup(**changes), out, lambda e: f"python -m lab experiment {e.name}", Console(quiet=True))
