"""Jain's index of the sensors' served visits (the paper: 0.980)."""

from __future__ import annotations

from lab.experiments.plan import Experiment, FigureSpec
from lab.experiments.schemes import every_scheme

EXPERIMENT = Experiment(
    name="fairness",
    title="Fairness between sensors",
    summary="Jain's index of served visits for every scheme, random included",
    schemes=lambda setup: every_scheme(),
    measures=("jain", "jain_scheduled", "lost_packets", "events"),
    figures=(
        FigureSpec("fairness", "bars", ("jain", "jain_scheduled"), "Jain's index of the sensors' visits."),
        FigureSpec(
            "fairness_and_loss", "bars", ("jain", "lost_packets"), "Jain's index, and the packets lost meanwhile."
        ),
    ),
    references=("random",),
    paired_measures=("jain", "jain_scheduled", "lost_packets"),
    when_quick="no_llm",
    notes=(
        "Jain's index (sum x)^2 / (J sum x^2) of a mission's visits x_j to sensor j. Served: with f = 0. Scheduled: "
        "chosen, served or not. Uniform choice schedules nearly evenly by chance alone (about 0.91, more where UAVs "
        "of a step never choose the same sensor, as here), whatever is lost. The paper does not say which it counts.",
    ),
)
