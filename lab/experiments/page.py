"""The results page: a verdict on each of the paper's numbers, and the results of every experiment."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from jinja2 import Environment, PackageLoader, StrictUndefined
from pydantic import ValidationError
from rich.console import Console
from tyro.conf import arg

from lab.experiments import claims, jain
from lab.experiments.catalogue import EXPERIMENTS
from lab.experiments.evidence import ZERO, flew_all
from lab.experiments.plots import draw, label_of, measured
from lab.experiments.result import Figure, Interval, Result
from lab.experiments.tables import cell, measure_tables, pair_tables, row_label
from shared.world.scenario import Scenario
from simulator.commands.running import command_main
from simulator.errors import UsageError
from simulator.records.run_folder import naming_out

RESULT = "results.json"
FIGURES = "figures"


@dataclass(frozen=True)
class PageOptions:
    """Write the results page: the paper's numbers beside ours, and every experiment's figures and tables.

    Experiments that were not run are listed as such. The command replaces an existing page and its figures.

    Try it:  python -m lab experiment page --runs runs/experiments --out docs/results/experiments.md

    Exit code: 0 written, 2 bad use.
    """

    runs: Annotated[Path, arg(metavar="DIR")] = Path("runs/experiments")
    """Folder of the experiments' results (their --out)."""
    out: Annotated[Path, arg(metavar="FILE.md")] = Path("docs/results/experiments.md")
    """The page; its figures go to the folder figures beside it."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab experiment page``; returns the exit code."""
    return command_main(PageOptions, "python -m lab experiment page", argv, _page)


def _page(options: PageOptions, console: Console) -> int:
    write_page(options.runs, options.out)
    console.print(f"Wrote {options.out}", markup=False, highlight=False)
    return 0


def write_page(runs: Path, out: Path) -> None:
    """Write the Markdown page ``out``, and its figures into the folder ``figures`` beside it.

    Args:
        runs: the folder of ``python -m lab experiment``. The page lists experiments without a result as not run.

    Raises:
        UsageError: the folder has no result, a result cannot be read, or the page cannot be written.
    """
    found = results_in(runs)
    with naming_out(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        drawn = {name: _figures(result, out.parent / FIGURES / name) for name, result in found.items()}
        out.write_text(render_page(found, drawn, out.parent), encoding="utf-8")


def results_in(runs: Path) -> dict[str, Result]:
    """The results in ``runs`` and its folders by experiment; full runs win over quick ones, then later over earlier.

    Raises:
        UsageError: the folder has no result, or one cannot be read.
    """
    paths = sorted([*runs.glob(RESULT), *runs.glob(f"*/{RESULT}")])
    if not paths:
        raise UsageError(f"--runs {runs} has no {RESULT}; make some with: python -m lab experiment all --out {runs}")
    results = sorted((_read(path) for path in paths), key=lambda result: (not result.quick, result.created_at))
    return {result.experiment: result for result in results}


def _read(path: Path) -> Result:
    try:
        return Result.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        first = error.errors(include_url=False)[0] if isinstance(error, ValidationError) else None
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}" if first else str(error)
        raise UsageError(f"{path}: {why}; run that experiment again") from None


def _figures(result: Result, folder: Path) -> list[tuple[Figure, Path]]:
    for stale in folder.glob("*.svg"):
        stale.unlink()
    paths = {path.stem: path for path in draw(result, folder, ("svg",))}
    return [(figure, paths[figure.name]) for figure in result.figures if figure.name in paths]


def render_page(results: Mapping[str, Result], drawn: Mapping[str, Sequence[tuple[Figure, Path]]], folder: Path) -> str:
    """The page's text; links to figures are relative to ``folder``."""
    environment = Environment(
        loader=PackageLoader("lab.experiments", "."), undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters.update(cell=cell, rounded=rounded, seeds=seeds_text)
    full = {name: result for name, result in results.items() if not (result.quick or claims.elsewhere(result))}
    findings = claims.judge(results)
    return environment.get_template("results.md.j2").render(
        findings=findings,
        adapted=claims.judge_with_adapter(results),
        verdicts={v: sum(f.verdict is v for f in findings) for v in claims.Verdict},
        experiments=[*EXPERIMENTS, *sorted(results.keys() - set(EXPERIMENTS))],
        results=results,
        figures={
            name: [(figure, Path(os.path.relpath(path, folder)).as_posix()) for figure, path in pictures]
            for name, pictures in drawn.items()
        },
        measure_tables=measure_tables,
        pair_tables=pair_tables,
        fairness=Fairness.of(results.get("fairness")),
        claims=claims,
        zero=ZERO,
        paper=Scenario(),
        by_time=swap(late_and_whole(full.get("scheduler"))),
        by_measure=swap(packets_and_events(full.get("scheduler"))),
        bound=full["scheduler"].bound.get("lost_packets") if "scheduler" in full else None,
        learned=_learned(full.get("attention")),
    )


@dataclass(frozen=True)
class Evenness:
    """One scheme's Jain's index of visits served and of visits scheduled, and its lost packets.

    ``on_all_seeds``: whether it flew every world of the result, so that its mean can be compared with others'.
    """

    label: str
    on_all_seeds: bool
    served: Interval
    scheduled: Interval | None
    lost: Interval | None


@dataclass(frozen=True)
class Fairness:
    """Jain's index by chance, by need, and as measured, the most even scheme first."""

    visits: int
    sensors: int
    uavs: int
    by_chance: float
    by_chance_apart: float
    reached_by_chance_pct: float
    by_need: float
    rows: list[Evenness]
    random: Evenness | None
    quick: bool

    @classmethod
    def of(cls, result: Result | None) -> Fairness:
        """The indices from the fairness experiment's result; without one, only the computed ones."""
        paper = Scenario()
        visits = paper.uavs * paper.steps
        by_name = {
            name: Evenness(
                row_label(result, name),
                flew_all(result, name),
                served,
                measured(result, name, "jain_scheduled"),
                measured(result, name, "lost_packets"),
            )
            for name in (result.schemes if result else ())
            if result and (served := measured(result, name, "jain"))
        }
        return cls(
            visits=visits,
            sensors=paper.sensors,
            uavs=paper.uavs,
            by_chance_apart=jain.expected_by_chance(visits, paper.sensors, paper.uavs),
            by_chance=jain.expected_by_chance(visits, paper.sensors),
            reached_by_chance_pct=100 * jain.reached_by_chance(claims.JAIN, visits, paper.sensors, paper.uavs),
            by_need=jain.of_proportional_visits(paper.arrival_rate_min, paper.arrival_rate_max, paper.sensors),
            rows=sorted(by_name.values(), key=lambda row: -row.served.mean),
            random=by_name.get("random"),
            quick=result is not None and result.quick,
        )

    @property
    def most_even(self) -> Evenness | None:
        """The most even of the schemes that flew all worlds; ``None`` if there is none."""
        return next((row for row in self.rows if row.on_all_seeds), None)

    @property
    def least_lossy(self) -> Evenness | None:
        """The scheme of those with the fewest lost packets; ``None`` without measured losses."""
        losses = [(row.lost.mean, index) for index, row in enumerate(self.rows) if row.lost and row.on_all_seeds]
        return self.rows[min(losses)[1]] if losses else None


@dataclass(frozen=True)
class Swap:
    """Two schemes that two measures rank differently: ``a`` is below ``b`` in ``less`` and above it in ``more``.

    Values are ``(a's, b's)``.
    """

    a: str
    b: str
    less: tuple[float, float]
    more: tuple[float, float]


def swap(values: Mapping[str, tuple[float, float]]) -> Swap | None:
    """The pair of schemes that the two values rank most differently; ``None`` if the rankings agree."""
    pairs = [
        Swap(a, b, (values[a][0], values[b][0]), (values[a][1], values[b][1]))
        for a in values
        for b in values
        if values[a][0] < values[b][0] and values[a][1] > values[b][1]
    ]
    return max(pairs, key=lambda p: (1 - p.less[0] / p.less[1]) * (1 - p.more[1] / p.more[0]), default=None)


def late_and_whole(result: Result | None) -> dict[str, tuple[float, float]]:
    """Lost packets in a mission's last third and in all of it, by label of the schemes that flew all worlds."""
    curves = {
        label_of(result, name): found["lost_packets_per_step"].mean
        for name, found in (result.curves if result else {}).items()
        if result and "lost_packets_per_step" in found and flew_all(result, name)
    }
    return {label: (sum(mean[-(len(mean) // 3) :]), sum(mean)) for label, mean in curves.items()}


def packets_and_events(result: Result | None) -> dict[str, tuple[float, float]]:
    """Lost packets and loss events of a mission, by label of the schemes that flew all worlds."""
    return {
        label_of(result, name): (packets.mean, events.mean)
        for name in (result.schemes if result else ())
        if result
        and flew_all(result, name)
        and (packets := measured(result, name, "lost_packets"))
        and (events := measured(result, name, "events"))
    }


def _learned(result: Result | None) -> tuple[Interval, Interval] | None:
    """Lost packets in mode value, from random weights and from the shipped ones."""
    if result is None:
        return None
    found = [measured(result, name, "lost_packets") for name in ("value_random_start", "value")]
    return (found[0], found[1]) if found[0] and found[1] else None


def rounded(value: float) -> str:
    """A number for a sentence, rounded to an integer from 100 on."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:,.1f}"


def seeds_text(seeds: Sequence[int]) -> str:
    """Seeds in words: ``0 to 29 (30)``."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]} ({len(seeds)})"
    return f"{', '.join(map(str, seeds))} ({len(seeds)})"
