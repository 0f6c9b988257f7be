"""The results of a flight in the folder of its log: the summary, the report, and the outcome on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from simulator.records.flight import Flight
from simulator.records.run_folder import DECISIONS, FIGURES, REPORT, REQUESTS, SUMMARY, naming_out
from simulator.records.summary import Summary, Tally
from simulator.reporting.terminal_table import show


def write_results(
    out: Path, summary: Summary, flight: Flight, tallies: Mapping[str, Sequence[Tally]], console: Console
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
