"""Five questions about the edge's cost, each answered in one table; `make bench` runs this in under ten minutes.

    python -m benchmarks.questions
    python -m benchmarks.questions --page docs/results/benchmarks.md

1. What does the edge add to an LLM server's latency? Beside a bare forwarder and LiteLLM's proxy, in the same rounds.
2. What does a decision cost, by mode? In processor time, compared with a bare forwarder's for a request.
3. How does that grow with sensors, UAVs and missions?
4. How long does a start take? Beside the imports of numba and FastAPI.
5. What does the embedded LLM take? Beside the same LLM with one thread, and with an empty prefix cache.

Each is a shorter run of another benchmark of this package, which explains itself with --help and measures more. It
prints the tables and the goals, and writes them as JSON. With --page it also writes them into that page, between the
lines `<!-- five tables -->` and `<!-- end of the five tables -->`, and their numbers with the commit into
`data/five-tables.csv` beside it.
"""

from __future__ import annotations

import csv
import re
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import capacity, fleet, llm, overhead, sensors, startup
from benchmarks.harness import Cell, Goal, Options, Report, Rows, run, shown
from lab.experiments.execution import commit

LONGEST_S = 600.0
_BEGIN, _END = "<!-- five tables -->", "<!-- end of the five tables -->"
# Sensors and missions that are compared, the fewest first.
_SENSORS, _MISSIONS = (10, 100, 1000), (1, 10, 100, 1000)
_LLM_RATIOS = {
    "guided, 2 threads: cached / cold": "mode `guided`: prefix in the cache, to an empty cache",
    "llm, 2 threads: cached / cold": "mode `llm`: prefix in the cache, to an empty cache",
    "2 threads: scoring / generating": "scoring labels, to generating an answer",
    "scoring, cached quiet: 2 threads / 1": "two threads, to one",
}


@dataclass(frozen=True)
class Questions(Options):
    """Answer the five questions."""

    litellm: str = "install"
    """`install`, the path of a `litellm` program, or `none`."""
    page: Path | None = None
    """A page whose five tables are replaced."""


def measure(args: Questions) -> Report:
    """Measure one after the other."""
    began = time.monotonic()
    loads = overhead.measure(overhead.Overhead(rounds=5, litellm=args.litellm))
    rows = {(row["service"], row["uavs"]): row for row in loads.figures["rows"]}
    with tempfile.TemporaryDirectory() as folder:
        modes = capacity.modes(Path(folder), capacity.Capacity(flights=1))
    reports = {
        "sensors": sensors.measure(sensors.Sensors(sensors=_SENSORS, rounds=2)),
        "missions": fleet.measure(fleet.Fleet(missions=_MISSIONS, decisions=600, rounds=1)),
        "start": startup.measure(startup.Startup(rounds=2)),
        "llm": llm.measure(llm.Llm(rounds=3)),
    }
    tables = {
        "1. What the edge adds to an LLM server's latency": _added(rows),
        "2. What a decision costs, by mode": _by_mode(modes, rows["bare", 3]["cpu"]),
        "3. How the cost grows": _growth(rows, reports["sensors"].figures, reports["missions"].figures),
        "4. How long a start takes": _starts(reports["start"].figures),
        "5. What the embedded LLM takes": _llm(reports["llm"].figures),
    }
    if args.page is not None:
        write(args.page, tables)
    took = time.monotonic() - began
    goals = [*loads.goals, *(goal for report in reports.values() for goal in report.goals)]
    figures = {"seconds": round(took, 1), "tables": tables, "loads": loads.figures, "modes": modes}
    figures |= {name: report.figures for name, report in reports.items()}
    return Report(figures, tables, [*goals, Goal("seconds of all five", took, most=LONGEST_S)])


def _added(rows: Mapping[tuple[str, int], Mapping[str, Any]]) -> Rows:
    """The edge's ratios to each peer."""
    found: dict[str, dict[str, Cell]] = {}
    for (service, uavs), row in rows.items():
        if service != "edge":
            continue
        for peer, named in (("bare", "a bare forwarder"), ("litellm", "LiteLLM's proxy")):
            if f"to {peer}" in row:
                found[f"{uavs} UAVs, to {named}"] = {
                    overhead.RATIOS[quantity]: row[f"to {peer}"][quantity] for quantity in overhead.QUANTITIES
                }
    return found


def _by_mode(modes: Mapping[str, Mapping[str, float]], bare_ms: float) -> Rows:
    """Processor time by mode, and its ratio to a bare forwarder's."""
    return {
        f"mode `{mode.partition(',')[0]}`,{mode.partition(',')[2]}": {
            "processor ms": 1e3 * costs["edge_s"],
            "to a bare forwarder's request": 1e3 * costs["edge_s"] / bare_ms,
        }
        for mode, costs in modes.items()
    }


def _growth(
    rows: Mapping[tuple[str, int], Mapping[str, Any]], by_sensors: Mapping[str, Any], by_missions: Mapping[str, Any]
) -> Rows:
    """The ratio of each cost with more sensors, UAVs or missions to that with the fewest."""
    found: dict[str, dict[str, Cell]] = {
        f"{most:,} sensors to {_SENSORS[0]}: the edge's share of a decision, mode `{mode}`": {
            "ratio": ratios[str(most)]
        }
        for most in _SENSORS[1:]
        for mode, ratios in by_sensors["share_ratio"].items()
    }
    for service, named in (("edge", "the edge's"), ("bare", "a bare forwarder's")):
        few, many = (rows[service, uavs]["cpu"] for uavs in (3, 64))
        found[f"64 UAVs at once to 3: {named} processor time"] = {"ratio": many / few}
    rates = by_missions["rates"]
    first, *more = _MISSIONS
    for most in more:
        ratio = rates[str(first)]["decisions_a_s"] / rates[str(most)]["decisions_a_s"]
        found[f"{most:,} missions to {first}: seconds a decision"] = {"ratio": ratio}
    return found


def _starts(figures: Mapping[str, Any]) -> Rows:
    """Seconds of each start that a user waits for, and their ratio to the imports alone."""
    medians = figures["median_s"]
    return {
        name: {"seconds": medians[each], "to the imports": medians[each] / medians[startup.IMPORTS]}
        for each, name in (
            (startup.IMPORTS, f"`python -c '{startup.IMPORTS}'`"),
            (startup.HEALTHZ, "`aicvds serve` until `/healthz` answers"),
            (startup.DECIDE, "until a decision that is requested at once"),
            (startup.HELP, "`aicvds --help`"),
        )
    }


def _llm(figures: Mapping[str, Any]) -> Rows:
    """Seconds of an answer, and ratios."""
    return {named: {"ratio of times": figures["ratios"][name]} for name, named in _LLM_RATIOS.items()}


def markdown(tables: Mapping[str, Rows]) -> str:
    """The tables as Markdown."""
    text = ""
    for title, rows in tables.items():
        columns = list(dict.fromkeys(column for row in rows.values() for column in row))
        text += f"\n### {title}\n\n| | {' | '.join(columns)} |\n|{'---|' * (len(columns) + 1)}\n"
        for name, row in rows.items():
            text += f"| {name} | {' | '.join(shown(row.get(column, '')) for column in columns)} |\n"
    return text


def write(page: Path, tables: Mapping[str, Rows]) -> None:
    """Write the tables into a page, and their numbers into a CSV file: an interval as middle, low and high.

    Raises:
        ValueError: the page lacks the markers of the tables.
    """
    text = page.read_text(encoding="utf-8")
    place = re.compile(f"{re.escape(_BEGIN)}\n.*{re.escape(_END)}", re.DOTALL)
    if not place.search(text):
        raise ValueError(f"{page} has no lines {_BEGIN} and {_END}")
    # Read before the page changes, which would mark the commit as dirty.
    measured = commit()
    made = f"{_BEGIN}\n{markdown(tables)}\n{_END}"
    page.write_text(place.sub(lambda _: made, text), encoding="utf-8")
    data = page.parent / "data" / "five-tables.csv"
    data.parent.mkdir(exist_ok=True)
    with data.open("w", newline="", encoding="utf-8") as file:
        sheet = csv.writer(file, lineterminator="\n")
        sheet.writerow(("table", "row", "column", "value", "low", "high", "commit"))
        for title, rows in tables.items():
            for name, row in rows.items():
                for column, cell in row.items():
                    numbers = [cell, "", ""] if isinstance(cell, str | int | float) else cell
                    sheet.writerow((title, name, column, *numbers, measured))


if __name__ == "__main__":
    run(Questions, measure)
