"""Every scheme and the clairvoyant bound on the same worlds (the paper's comparison of schedulers)."""

from __future__ import annotations

from lab.experiments.measures import LOSS_CURVES, LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import BOUND, Scheme, every_scheme


def _schemes(setup: Setup) -> list[Scheme]:
    return [*every_scheme(), BOUND]


EXPERIMENT = Experiment(
    name="scheduler",
    title="What each scheme loses",
    summary="every scheme and the clairvoyant bound: lost packets and loss events, per step and cumulative",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "collected", "velocity", "llm_decided_pct"),
    figures=(
        FigureSpec("scheduler", "curves", LOSS_CURVES, "Lost packets and loss events, per step and cumulative."),
        FigureSpec("scheduler_totals", "bars", LOSSES, "Lost packets and loss events of a mission."),
    ),
    references=("eof", "wqcs"),
    notes=(
        "EOF and WQCS are the paper's. The longest queue, queue and channel, maximum channel gain, nearest neighbour "
        "and round robin choose the sensor only, at a constant 7 m/s; `at full speed` is the same choice at the "
        "scenario's highest velocity.",
        "The bound knows every arrival beforehand, which no scheme does; the line is the proven lower bound.",
    ),
)
