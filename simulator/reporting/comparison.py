"""Several missions side by side: a table of their numbers, and a page with their figures."""

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from simulator.errors import UsageError
from simulator.records.run_folder import FIGURES, SUMMARY
from simulator.records.summary import Summary
from simulator.reporting.wording import deciders_text, number, world_text

# The figures of a mission's report, in its order, with their titles.
TITLES = {
    "losses": "Losses",
    "latency-map": "Round trip on the map",
    "latency-steps": "Round trip by step",
    "tokens": "Prompt tokens",
    "visits": "Visits of each sensor",
    "deciders": "Sources of the decisions",
}


@dataclass(frozen=True)
class MissionResult:
    """One mission's folder, and its summary."""

    folder: Path
    summary: Summary

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self.folder.resolve().name

    @property
    def lost(self) -> int:
        """Packets that the mission lost, of whichever policy it flew."""
        return next(iter(self.summary.lost_packets.values()), 0)


def read_result(folder: Path) -> MissionResult:
    """The mission in a folder that `aicvds simulate`, `demo` or `replay` wrote.

    Raises:
        UsageError: it has no summary, or one that cannot be read.
    """
    file = folder / SUMMARY
    try:
        return MissionResult(folder, Summary.model_validate_json(file.read_bytes()))
    except OSError as error:
        raise UsageError(f"{file}: {error.strerror}; name the --out folder of a mission") from None
    except ValueError:
        raise UsageError(f"{file}: this is no mission's summary") from None


# fmt: off
ROWS: dict[str, Callable[[MissionResult], str]] = {
    "world": lambda run: world_text(run.summary),
    "steps flown": lambda run: f"{run.summary.steps_flown} of {run.summary.steps}",
    "policy, mode": lambda run: run.summary.policy + (f", {run.summary.mode}" if run.summary.mode else ""),
    "LLM": lambda run: run.summary.model or "–" if run.summary.mode in (None, "guided", "llm") else "–",
    "decisions": lambda run: deciders_text(run.summary),
    "lost packets": lambda run: number(run.lost, 0),
    "nobody can lose fewer than": lambda run: number(run.summary.bound.lower_bound if run.summary.bound else None, 0),
    "EOF's lost packets": lambda run: number(run.summary.lost_packets.get("eof"), 0),
    "loss events": lambda run: number(next(iter(run.summary.loss_events.values()), None), 0),
    "failed transmissions": lambda run: number(run.summary.failures, 0),
    "round trip, median, ms": lambda run: number(run.summary.rtt_ms.p50),
    "round trip, 99th percentile, ms": lambda run: number(run.summary.rtt_ms.p99),
    "later than deadline + 50 ms": lambda run: number(run.summary.late, 0),
    "prompt, mean tokens": lambda run: number(run.summary.tokens.prompt_mean if run.summary.llm_asked else None),
    "request, mean bytes": lambda run: number(run.summary.uplink_bytes_mean, 0),
    "Jain's index of visits": lambda run: number(run.summary.jain, 3),
}
# fmt: on


def rows(runs: Sequence[MissionResult]) -> dict[str, list[str]]:
    """The table: each row's name with a cell for each run; rows without any number are left out."""
    table = {name: [cell(run) for run in runs] for name, cell in ROWS.items()}
    return {name: cells for name, cells in table.items() if set(cells) != {"–"}}


def caution(runs: Sequence[MissionResult]) -> str:
    """What the losses of these runs can be compared for."""
    worlds = {(s.scenario, s.seed, s.steps_flown, s.sensors, s.uavs) for s in (run.summary for run in runs)}
    if any(run.summary.real_uavs is not None for run in runs):
        return "Real UAVs know only the losses that beacons reported, so these losses cannot be compared."
    if len(worlds) > 1:
        return "These missions flew different worlds or numbers of steps, so their losses cannot be compared."
    return "One world is an example, not a result: docs/results/ compares over many."


def render_comparison(runs: Sequence[MissionResult]) -> str:
    """The page as HTML, which needs no other file."""
    pages = Environment(loader=PackageLoader("simulator.reporting", "."), autoescape=True, undefined=StrictUndefined)
    pages.trim_blocks = pages.lstrip_blocks = True
    drawn = {title: [_figure(run, name) for run in runs] for name, title in TITLES.items()}
    return pages.get_template("comparison.html.j2").render(
        names=names(runs),
        rows=rows(runs),
        caution=caution(runs),
        figures={title: images for title, images in drawn.items() if any(images)},
    )


def names(runs: Sequence[MissionResult]) -> list[str]:
    """A name for each run: its folder's, or the whole path where two folders have the same."""
    short = [run.name for run in runs]
    return [str(run.folder) if short.count(run.name) > 1 else run.name for run in runs]


def _figure(run: MissionResult, name: str) -> str | None:
    """The figure as a data URL; None where the run has none."""
    file = run.folder / FIGURES / f"{name}.svg"
    if not file.is_file():
        return None
    return "data:image/svg+xml;base64," + base64.b64encode(file.read_bytes()).decode()
