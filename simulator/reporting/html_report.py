"""``report.html``: a page about one mission that needs no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from shared.scenario import Scenario
from simulator.policies.reach import cruise_velocity
from simulator.records.decision import Decision
from simulator.records.run_folder import FIGURES
from simulator.records.summary import Summary, Tally
from simulator.reporting import figures
from simulator.reporting.figure_style import Drawing
from simulator.reporting.wording import llm_notice, number, policy_labels, verdict

COSTLIEST_DECISIONS = 15


def costliest(decisions: Sequence[Decision]) -> list[Decision]:
    """The decisions that cost most, the earlier first among equals."""
    return sorted(decisions, key=lambda d: (-d.cost, d.step, d.uav_id))[:COSTLIEST_DECISIONS]


def drawings(
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[Tally]],
    sensor_xy: np.ndarray,
) -> dict[str, Drawing]:
    """The figures that this mission has, by their place in the page.

    Args:
        summary: what ``summary.json`` holds.
        scenario: the world's numbers, for the trajectories.
        decisions: in order of step and UAV; may be none.
        tallies: per policy, one entry a step flown.
        sensor_xy: (J, 2), metres.
    """
    drawn = {
        "losses": figures.losses(tallies, policy_labels(summary)),
        "visits": figures.visits(decisions, scenario.sensors),
    }
    if summary.policy == "edge":
        drawn["map"] = figures.latency_map(scenario, sensor_xy, decisions)
        drawn["latency"] = figures.latency_per_step(decisions)
        drawn["deciders"] = figures.deciders(decisions)
    if summary.llm_asked:
        drawn["tokens"] = figures.tokens_per_step(decisions)
    return drawn


def render_report(
    summary: Summary, scenario: Scenario, decisions: Sequence[Decision], drawn: Mapping[str, Drawing]
) -> str:
    """The page as HTML; arguments as for ``drawings``, and what it returned."""
    pages = Environment(loader=PackageLoader("simulator.reporting", "."), autoescape=True, undefined=StrictUndefined)
    pages.trim_blocks = pages.lstrip_blocks = True
    pages.filters["number"] = number
    labels = policy_labels(summary)
    return pages.get_template("report.html.j2").render(
        s=summary,
        ours=next(iter(summary.lost_packets)),
        labels=labels,
        verdict=verdict(summary),
        notice=llm_notice(summary),
        sources=summary.by_source.present(),
        scenario=scenario,
        cruise=cruise_velocity(scenario),
        figures={name: Markup(one.inline) for name, one in drawn.items()},
        costliest=costliest(decisions),
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
    """Write the page, and beside it its figures for print into ``figures/``; arguments as for ``drawings``.

    Raises:
        OSError: a file cannot be written.
    """
    drawn = drawings(summary, scenario, decisions, tallies, sensor_xy)
    path.write_text(render_report(summary, scenario, decisions, drawn), encoding="utf-8")
    folder = path.parent / FIGURES
    folder.mkdir(exist_ok=True)
    for one in drawn.values():
        one.write(folder)
