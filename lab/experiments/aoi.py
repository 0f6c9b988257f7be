"""Age of information, FRSICL's objective, with its nearest-neighbour baseline."""

from __future__ import annotations

from lab.experiments.plan import Experiment, FigureSpec
from lab.experiments.schemes import every_scheme

_AGES = ("aoi_mean", "aoi_peak", "aoi_worst")
EXPERIMENT = Experiment(
    name="aoi",
    title="Age of information",
    summary="mean and peak age of information a sensor, with the nearest-neighbour baseline",
    schemes=lambda setup: every_scheme(),
    measures=(*_AGES, "lost_packets", "events"),
    figures=(
        FigureSpec("aoi", "curves", ("aoi_per_step",), "Age of information, mean over the sensors."),
        FigureSpec("aoi_totals", "bars", ("aoi_mean", "aoi_peak"), "Mean and peak age of information of a mission."),
    ),
    references=("nearest",),
    paired_measures=("aoi_mean", "aoi_peak", "lost_packets"),
    when_quick="no_llm",
    notes=(
        "Age of sensor j at the end of step t, in steps: A_j(t) = 1 if it was served (f = 0) in step t, else "
        "A_j(t-1) + 1, with A_j(-1) = 0. Mean: over all sensors and steps. Peak: a sensor's largest, mean "
        "over the sensors; worst: of the sensor with the largest. No scheme here was made to keep ages low.",
    ),
)
