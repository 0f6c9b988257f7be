"""The results of a flight in the folder of its log: the summary, the report, and the outcome on the terminal."""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console
from rich.table import Table

from simulator.records.flight import Flight
from simulator.records.real_uavs import RealUavs
from simulator.records.run_folder import DECISIONS, FIGURES, REPORT, REQUESTS, SUMMARY, naming_out
from simulator.records.summary import Summary
from simulator.reporting.wording import (
    bound_text,
    deciders_text,
    late_text,
    llm_notice,
    number,
    orders_text,
    policy_labels,
    world_text,
)
from simulator.world.observation import StepTally


def write_results(
    out: Path, summary: Summary, flight: Flight, tallies: Mapping[str, Sequence[StepTally]], console: Console
) -> None:
    """Write a flight's summary and report into the folder of its log, and print the outcome and the file names.

    Without matplotlib, as where only real UAVs are flown, there is no report.

    Raises:
        UsageError: the folder cannot be written.
    """
    drawn = () if find_spec("matplotlib") is None else (REPORT, FIGURES)
    with console.status("Drawing the report"), naming_out(out):
        (out / SUMMARY).write_text(summary.model_dump_json(indent=2) + "\n", encoding="utf-8")
        if drawn:
            from simulator.reporting.html_report import write_report

            world = (flight.sensor_xy, flight.track)
            write_report(out / REPORT, summary, flight.scenario, flight.decisions, tallies, *world)
    show(summary, console)
    if not drawn:
        console.print("No report: matplotlib is not installed; pip install 'aic-vds[simulator]'", markup=False)
    for name in (SUMMARY, DECISIONS, *drawn, *((REQUESTS,) if summary.edge else ())):
        console.print(f"Wrote {out / name}", markup=False, highlight=False, soft_wrap=True)


def show(summary: Summary, console: Console) -> None:
    """Print the outcome with those of EOF and WQCS, and the sources of the decisions."""
    whole = summary.steps_flown == summary.steps and not summary.interrupted
    steps = f"{summary.steps} steps" if whole else f"{summary.steps_flown} of {summary.steps} steps"
    table = Table(title=f"Scenario {world_text(summary)}, {steps}")
    table.add_column("policy")
    table.add_column("lost packets" if summary.real_uavs is None else "lost packets heard of", justify="right")
    table.add_column("loss events", justify="right")
    labels = policy_labels(summary)
    for name, lost in summary.lost_packets.items():
        table.add_row(labels[name], f"{lost:,}", f"{summary.loss_events[name]:,}")
    console.print(table)
    if summary.real_uavs is not None:
        _show_real_uavs(summary, summary.real_uavs, console)
    if (notice := llm_notice(summary)) is not None:
        console.print(
            notice, style="yellow" if summary.mode == "llm" else None, markup=False, highlight=False, soft_wrap=True
        )
    if (bound := bound_text(summary)) is not None:
        console.print(bound, markup=False, highlight=False, soft_wrap=True)
    if summary.policy == "edge":
        console.print(f"{summary.decisions} decisions: {deciders_text(summary)}", markup=False)
    if (orders := orders_text(summary)) is not None:
        console.print(orders, markup=False, highlight=False, soft_wrap=True)
    if summary.operator is not None and summary.operator.deadlines:
        console.print(f"Visit deadlines: {summary.operator.met} met, {summary.operator.missed} missed")
    tokens, trips = summary.tokens, summary.rtt_ms
    if trips.p50 is not None:
        console.print(f"Round trip: median {trips.p50:.0f} ms, 99th percentile {trips.p99:.0f} ms")
        down = f"; {summary.attention_bytes_mean:.0f} down, to prune by" if summary.attention_bytes_mean else ""
        console.print(f"Uplink {summary.uplink}: {summary.uplink_bytes_mean:.0f} bytes a decision{down}")
    if summary.llm_asked and tokens.prompt_mean is not None:
        cached = "" if tokens.cached_pct is None else f"; {tokens.cached_pct:.0f} % read from the LLM's prefix cache"
        console.print(
            f"Prompt: {tokens.prompt_mean:.0f} tokens a decision, {tokens.uncompressed_mean:.0f} with full rows of "
            f"every sensor; the state block has {tokens.state_mean:.0f}, instead of "
            f"{tokens.state_uncompressed_mean:.0f}{cached}",
            soft_wrap=True,
        )


def _show_real_uavs(summary: Summary, real: RealUavs, console: Console) -> None:
    """Print each UAV's sums, what was late, and the commands not carried out."""
    table = Table(title="UAVs")
    table.add_column("UAV")
    for column in ("decisions", "collected", "failed", "lost in range", "m decided", "m flown", "round trip, ms"):
        table.add_column(column, justify="right")
    for one in real.uavs:
        sums = (one.decisions, one.collected, one.failures, one.lost_packets, one.decided_m, one.flown_m)
        table.add_row(str(one.uav_id), *(number(count, 0) for count in sums), number(one.rtt_ms, 0))
    lost, collected = sum(summary.lost_packets.values()), sum(one.collected for one in real.uavs)
    metres = sum(one.decided_m for one in real.uavs), sum(one.flown_m for one in real.uavs)
    whole = (summary.decisions, collected, summary.failures, lost, *metres)
    table.add_row("all", *(number(count, 0) for count in whole), number(summary.rtt_ms.p50, 0), style="bold")
    console.print(table)
    lines = [late_text(summary)]
    if real.simulated_lost is not None:
        lines.append(f"The simulated sensors lost {real.simulated_lost:,} packets, with those that no UAV heard of.")
    for line in lines + real.remarks():
        console.print(line, markup=False, highlight=False, soft_wrap=True)
