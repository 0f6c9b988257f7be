"""One mission told to people: ``report.html``, a page that needs nothing but itself, and the terminal's table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from rich.console import Console
from rich.table import Table

from shared.scenario import Scenario
from simulator import figures
from simulator.drawing import Drawing
from simulator.policies.reach import cruise_velocity
from simulator.record import FIGURES, Decision, Summary, Tally, told_sources

COSTLIEST_DECISIONS = 15
# Of the decisions, that the LLM must have taken for the mission to count as the LLM's.
LLM_SHARE = 0.9
NAMES = {
    "aic_vds": "AIC-VDS",
    "eof": "EOF",
    "wqcs": "WQCS",
    "round_robin": "round robin",
    "random": "random",
    "max_gain": "maximum channel gain",
    "nearest": "nearest neighbour",
}


def policy_labels(summary: Summary) -> dict[str, str]:
    """The policies' names as people write them; the edge's with who really decided."""
    flown = {"aic_vds": f"AIC-VDS ({told_sources(summary.by_source)})"} if summary.decisions else {}
    return {**dict(zip(summary.lost_packets, summary.lost_packets, strict=True)), **NAMES, **flown}


def llm_notice(summary: Summary) -> str | None:
    """A warning when the LLM was to decide and too often did not; ``None`` when there is nothing to warn of."""
    by = summary.by_source
    asks = summary.mode in ("llm", "guided")
    if not asks or summary.policy != "edge" or by.llm + by.guided >= LLM_SHARE * summary.decisions:
        return None
    owners = [
        f"{words} {count}"
        for words, count in (
            ("the edge's LLM-free policy's", by.policy),
            ("its learned values'", by.value),
            ("the UAVs' own", by.onboard),
        )
        if count
    ]
    reasons = ", ".join(f"{reason} {count}" for reason, count in summary.by_reason.items())
    return (
        f"The LLM took {by.llm + by.guided} of {summary.decisions} decisions; the rest are {' and '.join(owners)} "
        f"(reasons: {reasons or 'none given'}), so this is not a result of the LLM."
    )


def verdict(summary: Summary) -> str:
    """The outcome in one sentence."""
    if not summary.steps_flown:
        return "Nothing was flown, so there is nothing to compare."
    name, *others = summary.lost_packets
    labels = policy_labels(summary)
    lost, rivals = summary.lost_packets[name], [summary.lost_packets[other] for other in others]
    told = f"In this one example {labels[name]} lost {lost:,} packets"
    if not rivals:
        return f"{told}."
    against = " and ".join(f"{labels[other]}'s {summary.lost_packets[other]:,}" for other in others)
    if {lost} == set(rivals):
        rank = "the same"
    elif lost < min(rivals):
        rank = "the fewest"
    elif lost > max(rivals):
        rank = "the most"
    else:
        rank = "as many as the best of them" if lost == min(rivals) else "neither the fewest nor the most"
    return f"{told} against {against}: {rank}."


def number(value: float | None, digits: int = 1) -> str:
    """A figure for a table, thousands apart by a comma; a dash when there is none."""
    return "–" if value is None else f"{value:,.{digits}f}"


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
    pages = Environment(loader=PackageLoader("simulator", "."), autoescape=True, undefined=StrictUndefined)
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


def show(summary: Summary, console: Console) -> None:
    """Print the outcome beside EOF and WQCS, and who decided."""
    steps = f"{summary.steps_flown} of {summary.steps} steps" if summary.interrupted else f"{summary.steps} steps"
    table = Table(title=f"Scenario {summary.scenario}, seed {summary.seed}, {steps}")
    table.add_column("policy")
    table.add_column("lost packets", justify="right")
    table.add_column("loss events", justify="right")
    labels = policy_labels(summary)
    for name, lost in summary.lost_packets.items():
        table.add_row(labels[name], f"{lost:,}", f"{summary.loss_events[name]:,}")
    console.print(table)
    if (notice := llm_notice(summary)) is not None:
        console.print(notice, style="yellow", markup=False, highlight=False, soft_wrap=True)
    if summary.policy == "edge":
        console.print(f"{summary.decisions} decisions: {told_sources(summary.by_source)}")
    tokens, trips = summary.tokens, summary.rtt_ms
    if trips.p50 is not None:
        console.print(f"Round trip: median {trips.p50:.0f} ms, 99th percentile {trips.p99:.0f} ms")
        down = f"; {summary.attention_bytes_mean:.0f} down, to prune by" if summary.attention_bytes_mean else ""
        console.print(f"Uplink {summary.uplink}: {summary.uplink_bytes_mean:.0f} bytes a decision{down}")
    if summary.llm_asked and tokens.prompt_mean is not None:
        cached = "" if tokens.cached_pct is None else f"; {tokens.cached_pct:.0f} % read from the LLM's prefix cache"
        console.print(
            f"Prompt: {tokens.prompt_mean:.0f} tokens a decision, {tokens.uncompressed_mean:.0f} with every sensor; "
            f"attention and masks leave {tokens.state_mean:.0f} of the state block's "
            f"{tokens.state_uncompressed_mean:.0f}{cached}",
            soft_wrap=True,
        )
