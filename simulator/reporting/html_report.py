"""``report.html``: a page about one mission that needs no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from shared.world.scenario import Scenario
from simulator.policies.reach import cruise_velocity
from simulator.records.decision import Decision
from simulator.records.run_folder import FIGURES
from simulator.records.summary import Summary, Tally
from simulator.records.track import Track
from simulator.reporting import figures
from simulator.reporting.figure_style import PaperFigure
from simulator.reporting.playback import Playback, playback
from simulator.reporting.wording import (
    ADVISERS,
    bound_text,
    late_text,
    llm_notice,
    number,
    orders_text,
    percent,
    policy_labels,
    verdict,
    world_text,
)

COSTLIEST_DECISIONS = 15


def costliest(decisions: Sequence[Decision]) -> list[Decision]:
    """The decisions with the highest cost above 0; of equals the earlier one first."""
    costly = [d for d in decisions if d.cost > 0]
    return sorted(costly, key=lambda d: (-d.cost, d.step, d.uav_id))[:COSTLIEST_DECISIONS]


def drawings(
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[Tally]],
    sensor_xy: np.ndarray,
) -> dict[str, PaperFigure]:
    """The figures of this mission by their name in the page.

    Args:
        summary: the content of ``summary.json``.
        scenario: of the mission, for the trajectories.
        decisions: in order of step and UAV; may be empty.
        tallies: by policy, one entry a step flown.
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
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    drawn: Mapping[str, PaperFigure],
    played: Playback | None = None,
) -> str:
    """The page as HTML; arguments as for ``drawings``, ``drawn`` is its result, and ``played`` a flight's playback."""
    pages = Environment(loader=PackageLoader("simulator.reporting", "."), autoescape=True, undefined=StrictUndefined)
    pages.trim_blocks = pages.lstrip_blocks = True
    pages.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    pages.filters["number"] = number
    pages.filters["percent"] = percent
    labels = policy_labels(summary)
    return pages.get_template("report.html.j2").render(
        s=summary,
        ours=next(iter(summary.lost_packets)),
        labels=labels,
        verdict=verdict(summary),
        world=world_text(summary),
        late=late_text(summary),
        bound=bound_text(summary),
        orders=orders_text(summary),
        advisers={name: ADVISERS.get(name, name) for name in summary.trust},
        notice=llm_notice(summary),
        sources=summary.by_source.present(),
        scenario=scenario,
        cruise=cruise_velocity(scenario),
        figures={name: Markup(one.inline) for name, one in drawn.items()},
        costliest=costliest(decisions),
        maps=min(scenario.uavs, figures.MAPS),
        playback=played,
    )


def write_report(
    path: Path,
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[Tally]],
    sensor_xy: np.ndarray,
    track: Track,
) -> None:
    """Write the page, and its figures for print into the folder ``figures/`` next to it.

    The first arguments are those of ``drawings``; ``track`` is what the playback shows.

    Raises:
        OSError: a file cannot be written.
    """
    drawn = drawings(summary, scenario, decisions, tallies, sensor_xy)
    instants = track.until(summary.steps_flown)
    played = playback(scenario, sensor_xy, decisions, instants, track.stride)
    path.write_text(render_report(summary, scenario, decisions, drawn, played), encoding="utf-8")
    folder = path.parent / FIGURES
    folder.mkdir(exist_ok=True)
    for one in drawn.values():
        one.write(folder)
