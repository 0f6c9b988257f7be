"""The results page: a verdict on each of the paper's numbers, and the results of every experiment."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from pydantic import ValidationError
from rich.console import Console
from tyro.conf import arg

from lab.experiments import claims, jain
from lab.experiments.catalogue import EXPERIMENTS
from lab.experiments.evidence import ZERO, flew_all
from lab.experiments.findings import tidy
from lab.experiments.plots import draw, label_of, measured
from lab.experiments.result import Figure, Interval, Result
from lab.experiments.tables import cell, tables_of
from shared.world.scenario import Scenario
from simulator.commands.running import command_main
from simulator.errors import UsageError
from simulator.records.run_folder import naming_out

RESULT = "results.json"
FIGURES, DATA = "figures", "data/experiments"
# Digits of the page's numbers in its data: more than a page or a verdict needs.
_DIGITS = 6


@dataclass(frozen=True)
class PageOptions:
    """Write the results page: the paper's numbers beside ours, and every experiment's table and figure.

    The page is made from the results in the folder data/experiments beside it. With --runs the command first takes the
    results of new runs into that folder, where they replace older ones of the same experiment. It lists experiments
    without a result as not flown.

    Try it:  python -m lab experiment page --runs runs/experiments

    Exit code: 0 written, 2 bad use.
    """

    runs: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of new results (the experiments' --out). Default: none, the page is made again."""
    out: Annotated[Path, arg(metavar="FILE.md")] = Path("docs/results/experiments.md")
    """The page; its figures and data go to folders beside it."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab experiment page``; returns the exit code."""
    return command_main(PageOptions, "python -m lab experiment page", argv, _page)


def _page(options: PageOptions, console: Console) -> int:
    write_page(options.runs, options.out)
    console.print(f"Wrote {options.out}", markup=False, highlight=False)
    return 0


def write_page(runs: Path | None, out: Path) -> None:
    """Write the Markdown page ``out``, and its figures and data into folders beside it.

    Args:
        runs: the folder of ``python -m lab experiment`` with new results, if any.

    Raises:
        UsageError: there is no result, one cannot be read, or the page cannot be written.
    """
    data = out.parent / DATA
    new = [*results_in(runs).values()] if runs else []
    with naming_out(out):
        data.mkdir(parents=True, exist_ok=True)
        for result in _latest([*stored_in(data).values(), *new]).values():
            (data / f"{result.experiment}.json").write_text(_short(result), encoding="utf-8")
            (data / f"{result.experiment}.csv").write_text(tidy(result), encoding="utf-8")
        found = stored_in(data)
        if not found:
            raise UsageError(f"{data} has no results; take some in with --runs DIR")
        drawn = {name: _drawn(result, out.parent / FIGURES / name) for name, result in found.items()}
        out.write_text(render_page(found, drawn, out.parent), encoding="utf-8")


def stored_in(data: Path) -> dict[str, Result]:
    """The results that a page is made from, by experiment; raises ``UsageError`` for one that cannot be read."""
    return _latest([_read(path) for path in sorted(data.glob("*.json"))])


def results_in(runs: Path) -> dict[str, Result]:
    """The results in ``runs`` and its folders by experiment; full runs win over quick ones, then later over earlier.

    Raises:
        UsageError: the folder has no result, or one cannot be read.
    """
    paths = sorted([*runs.glob(RESULT), *runs.glob(f"*/{RESULT}")])
    if not paths:
        raise UsageError(f"--runs {runs} has no {RESULT}; make some with: python -m lab experiment all --out {runs}")
    return _latest([_read(path) for path in paths])


def _latest(results: Sequence[Result]) -> dict[str, Result]:
    in_order = sorted(results, key=lambda result: (not result.quick, result.created_at))
    return {result.experiment: result for result in in_order}


def _short(result: Result) -> str:
    """The result as JSON, with an entry a line and rounded numbers."""

    def rounded(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.{_DIGITS}g}")
        if isinstance(value, dict):
            return {key: rounded(each) for key, each in value.items()}
        return [rounded(each) for each in value] if isinstance(value, list) else value

    fields = rounded(result.model_dump(mode="json", exclude_defaults=True))
    lines = (f'"{name}":{json.dumps(value, separators=(",", ":"))}' for name, value in fields.items())
    return "{" + ",\n".join(lines) + "}\n"


def _read(path: Path) -> Result:
    try:
        return Result.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        first = error.errors(include_url=False)[0] if isinstance(error, ValidationError) else None
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}" if first else str(error)
        raise UsageError(f"{path}: {why}; run that experiment again") from None


def _drawn(result: Result, folder: Path) -> list[tuple[Figure, Path]]:
    for stale in folder.glob("*.svg"):
        stale.unlink()
    paths = {path.stem: path for path in draw(result.model_copy(update={"figures": shown(result)}), folder, ("svg",))}
    return [(figure, paths[figure.name]) for figure in shown(result) if figure.name in paths]


def shown(result: Result) -> list[Figure]:
    """The figure on the page: the first without curves if there is one, for curves of many schemes hide each other.

    A sweep needs two schemes at least.
    """
    swept = result.schemes.keys() & (result.sweep.at if result.sweep else {}).keys()
    drawn = [figure for figure in result.figures if figure.kind != "sweep" or len(swept) > 1]
    return sorted(drawn, key=lambda figure: figure.kind == "curves")[:1]


def render_page(results: Mapping[str, Result], drawn: Mapping[str, Sequence[tuple[Figure, Path]]], folder: Path) -> str:
    """The page's text; links to figures are relative to ``folder``."""
    environment = Environment(
        loader=PackageLoader("lab.experiments", "."), undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters.update(cell=cell, rounded=rounded, seeds=seeds_text)
    full = {name: result for name, result in results.items() if not (result.quick or claims.setting_difference(result))}
    often = Counter(note for result in results.values() for note in result.notes)
    judged = {
        "the LLM of `--llm`": claims.judge(results),
        "the embedded LLM and its adapter": claims.judge_with_adapter(results),
    }
    return environment.get_template("results.md.j2").render(
        judged={llm: found for llm, found in judged.items() if any(f.verdict and f.model for f in found)},
        verdicts=list(claims.Verdict),
        common=[note for note, times in often.items() if 2 * times > len(results) > 1],
        experiments=[*EXPERIMENTS, *sorted(results.keys() - set(EXPERIMENTS))],
        missing=[name for name in EXPERIMENTS if name not in results],
        results=results,
        figures={
            name: [(figure, Path(os.path.relpath(path, folder)).as_posix()) for figure, path in pictures]
            for name, pictures in drawn.items()
        },
        tables_of=tables_of,
        data=DATA,
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
    """Jain's index of visits served and of visits scheduled, and the lost packets, of a scheme that flew all worlds."""

    label: str
    served: Interval
    scheduled: Interval | None
    lost: Interval | None


@dataclass(frozen=True)
class Fairness:
    """Jain's index by chance, by need, and as measured, the most even scheme first; only of full runs."""

    visits: int
    sensors: int
    uavs: int
    by_chance: float
    by_chance_apart: float
    reached_by_chance_pct: float
    by_need: float
    rows: list[Evenness]
    random: Evenness | None

    @classmethod
    def of(cls, result: Result | None) -> Fairness:
        """The indices from the fairness experiment's result; without one, only the computed ones."""
        paper = Scenario()
        visits = paper.uavs * paper.steps
        by_name = {
            name: Evenness(
                label_of(result, name),
                served,
                measured(result, name, "jain_scheduled"),
                measured(result, name, "lost_packets"),
            )
            for name in (result.schemes if result else ())
            if result and not result.quick and flew_all(result, name) and (served := measured(result, name, "jain"))
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
        )

    @property
    def most_even(self) -> Evenness | None:
        """The most even of the schemes; ``None`` if there is none."""
        return next(iter(self.rows), None)

    @property
    def least_lossy(self) -> Evenness | None:
        """The scheme of those with the fewest lost packets; ``None`` without measured losses."""
        losses = [(row.lost.mean, index) for index, row in enumerate(self.rows) if row.lost]
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
