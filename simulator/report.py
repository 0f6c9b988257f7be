"""``report.html``: one mission on one page that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from shared.scenario import Scenario
from simulator import figures
from simulator.record import Decision, Summary, Tally

FIRST_DECISIONS = 15
NAMES = {"aic_vds": "AIC-VDS", "eof": "EOF", "wqcs": "WQCS", "round_robin": "round robin", "random": "random"}


def policy_label(name: str) -> str:
    """A policy's name as people write it."""
    return NAMES.get(name, name)


def number(value: float | None, digits: int = 1) -> str:
    """A figure for a table, thousands apart by a comma; a dash when there is none."""
    return "–" if value is None else f"{value:,.{digits}f}"


def render_report(
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[Tally]],
    sensor_xy: np.ndarray,
) -> str:
    """The page as HTML.

    Args:
        summary: what ``summary.json`` holds.
        scenario: the world's numbers, for the laps.
        decisions: in order of step and UAV; may be none.
        tallies: per policy, one entry a step flown.
        sensor_xy: (J, 2), metres.
    """
    pages = Environment(loader=PackageLoader("simulator", "."), autoescape=True, undefined=StrictUndefined)
    pages.trim_blocks = pages.lstrip_blocks = True
    pages.filters["number"] = number
    pages.filters["policy"] = policy_label
    drawn = {
        "map": figures.latency_map(scenario, sensor_xy, decisions),
        "latency": figures.latency_per_step(decisions),
        "losses": figures.losses(tallies, NAMES),
        "tokens": figures.tokens_per_step(decisions),
        "visits": figures.visits(decisions, scenario.sensors),
        "deciders": figures.deciders(decisions),
    }
    return pages.get_template("report.html.j2").render(
        s=summary,
        ours=next(iter(summary.lost_packets)),
        scenario=scenario,
        figures={name: Markup(svg) for name, svg in drawn.items()},
        first=decisions[:FIRST_DECISIONS],
        maps=min(scenario.uavs, figures.MAPS),
    )


def write_report(
    path: Path,
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[Tally]],
    sensor_xy: np.ndarray,
) -> None:
    """Write the page; arguments as for ``render_report``.

    Raises:
        OSError: the file cannot be written.
    """
    path.write_text(render_report(summary, scenario, decisions, tallies, sensor_xy), encoding="utf-8")
