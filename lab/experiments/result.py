"""``results.json``: the results of an experiment, for the figures, the tables and the results page."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from simulator.records.decision import Record


class Interval(Record):
    """A mean over seeds with its 95% bootstrap interval; ``values`` has one value a seed, as ``Result.seeds``."""

    mean: float
    low: float
    high: float
    values: list[float]


class Curve(Record):
    """A measure by step, mean over seeds with its 95% bootstrap interval, each of length T."""

    mean: list[float]
    low: list[float]
    high: list[float]


class Paired(Record):
    """A comparison on the same worlds: ``scheme``'s measure over or minus ``reference``'s, with a 95% interval."""

    scheme: str
    reference: str
    measure: str
    kind: Literal["ratio", "difference"]
    mean: float
    low: float
    high: float


class Figure(Record):
    """One figure of a result.

    ``curves``: the measures by step, one panel each; ``bars``: a bar a scheme, one panel a measure;
    ``sweep``: each measure over ``Result.sweep``.
    """

    name: str
    kind: Literal["curves", "bars", "sweep"]
    measures: list[str]
    caption: str


class Sweep(Record):
    """The x axis of a sweep: its label, and the position of each scheme."""

    label: str
    at: dict[str, float]


class Result(Record):
    """One experiment's results.

    ``schemes`` is by the name of the scheme, then of the measure, in display order. ``labels`` are the labels of
    schemes and measures. ``seeds_of`` has the schemes that flew fewer seeds than the rest. ``bound`` is the proven
    lower bound of each measure, a separate line and no scheme. In a result of several sites a measure's name ends with
    ``@`` and the site's. ``commit`` is that of the flights, or all of them, with commas between.
    """

    experiment: str
    title: str
    command: str
    version: str
    commit: str | None
    created_at: datetime
    quick: bool
    scenario: str
    seeds: list[int]
    model: str | None = None
    schemes: dict[str, dict[str, Interval]]
    bound: dict[str, Interval] = {}
    curves: dict[str, dict[str, Curve]] = {}
    paired: list[Paired] = []
    sweep: Sweep | None = None
    figures: list[Figure] = []
    labels: dict[str, str] = {}
    seeds_of: dict[str, list[int]] = {}
    notes: list[str] = []
