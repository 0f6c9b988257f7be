"""The run of experiments: fly and store missing flights, and write each experiment once its flights are complete."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lab.executors import executor
from lab.experiments.edges import edge_for
from lab.experiments.execution import CannotFly, fly_locally, fly_with_edge
from lab.experiments.flight import FlightRecord, FlightStore
from lab.experiments.measures import substituted_decisions
from lab.experiments.pace import Pace, duration_text
from lab.experiments.plan import Experiment, ExperimentPlan, Planned, Setup, plan
from lab.experiments.result import Result
from simulator.errors import UsageError
from simulator.records.run_folder import naming_out

FLIGHTS, RESULT, TABLE = "flights", "results.json", "results.csv"
# The interval of progress lines without a terminal.
_REPORT_EVERY_S = 30.0


@dataclass
class Run:
    """One run of the command.

    ``command_of`` gives the command line that makes one experiment. ``workers`` processes fly the flights without an
    edge, or the workers of the ``ray`` that is named.
    """

    setup: Setup
    out: Path
    command_of: Callable[[Experiment], str]
    console: Console
    workers: int = 1
    ray: str | None = None
    pace: Pace = field(default_factory=Pace)
    grounded: dict[str, str] = field(default_factory=dict)
    flown: int = 0

    def make(self, experiments: Sequence[Experiment]) -> list[Result]:
        """Make the experiments from stored and new flights.

        Raises:
            UsageError: the folder cannot be written.
            EdgeError: an edge died, or lacks an LLM that it needs.
            RayUnusable: flights are missing, and there is no such Ray.
            KeyboardInterrupt: the run was interrupted; finished flights are stored.
        """
        self.store = FlightStore(self.out / FLIGHTS)
        plans = self._plans(experiments)
        missing = self._missing(plans)
        waiting = {id(p): {f.key for f in p.flights} & missing.keys() for p in plans}
        self._print_start(plans, missing)
        results = [self._write(p) for p in plans if not waiting[id(p)]]
        for key in self._fly(missing):
            for p in plans:
                if key in waiting[id(p)]:
                    waiting[id(p)].remove(key)
                    if not waiting[id(p)]:
                        results.append(self._write(p))
        return results

    def _plans(self, experiments: Sequence[Experiment]) -> list[ExperimentPlan]:
        plans = [plan(each, self.setup) for each in experiments if each.chosen(self.setup)]
        empty = [p.experiment.name for p in plans if not p.flights]
        if len(empty) == len(plans):
            raise UsageError(f"experiment {', '.join(empty)}: every scheme of it asks an LLM; name one with --llm")
        if empty:
            self.console.print(f"Without an LLM there is nothing to fly for {', '.join(empty)}.", highlight=False)
        return [p for p in plans if p.flights]

    def _missing(self, plans: Sequence[ExperimentPlan]) -> dict[str, Planned]:
        missing, stored = {}, set()
        for planned in (flight for p in plans for flight in p.flights):
            if planned.key in stored or planned.key in missing:
                continue
            flight = self.store.load(planned.key)
            if flight is None:
                missing[planned.key] = planned
            else:
                stored.add(planned.key)
                self.pace.took(planned, flight.duration_s)
        return missing

    def _print_start(self, plans: Sequence[ExperimentPlan], missing: dict[str, Planned]) -> None:
        needed = {flight.key for p in plans for flight in p.flights}
        left = f"about {duration_text(self.pace.left_s(missing.values()))}" if missing else "nothing to fly"
        self.console.print(
            f"{len(needed)} flights, {len(needed) - len(missing)} of them flown before; {left}.", highlight=False
        )

    def _fly(self, missing: dict[str, Planned]) -> Iterator[str]:
        """Fly all of them, cheap ones first; yields each key once its flight is stored or has proved impossible."""
        left = dict(sorted(missing.items(), key=lambda item: _order(item[1])))
        with _progress(self.console, len(left)) as advance:
            for planned, flight in self._flights(list(left.values())):
                del left[planned.key]
                self.flown += 1
                if flight is not None:
                    self.store.save(planned.key, flight)
                    self.pace.took(planned, flight.duration_s)
                    self._warn_of_substitutes(planned, flight)
                advance(planned, self.pace.left_s(left.values()))
                yield planned.key

    def _flights(self, flights: Sequence[Planned]) -> Iterator[tuple[Planned, FlightRecord | None]]:
        yield from self._fly_locally([planned for planned in flights if planned.backing is None])
        for backing in dict.fromkeys(planned.backing for planned in flights if planned.backing is not None):
            name = "".join(c if c.isalnum() else "-" for c in Path(backing).stem)
            with edge_for(backing, self.setup.llm, self.out / f"edge-{name}.log", self.console) as edge:
                for planned in (p for p in flights if p.backing == backing):
                    yield planned, fly_with_edge(edge, planned)

    def _fly_locally(self, flights: Sequence[Planned]) -> Iterator[tuple[Planned, FlightRecord | None]]:
        # A planner searches for seconds in compiled code, which Ctrl-C does not interrupt: its process is ended.
        pooled = [planned for planned in flights if self.workers > 1 or self.ray or planned.plans]
        for planned in (planned for planned in flights if planned not in pooled):
            yield planned, self._record_of(planned, lambda planned=planned: fly_locally(planned))  # type: ignore[misc]
        if pooled:
            with executor(self.workers, self.ray) as pool:
                futures = {pool.submit(fly_locally, planned): planned for planned in pooled}
                for future in as_completed(futures):
                    yield futures[future], self._record_of(futures[future], future.result)

    def _record_of(self, planned: Planned, fly: Callable[[], FlightRecord]) -> FlightRecord | None:
        try:
            return fly()
        except CannotFly as error:
            self.grounded.setdefault(f"{planned.scheme.label} on {planned.site_name}", str(error))
            return None

    def _warn_of_substitutes(self, planned: Planned, flight: FlightRecord) -> None:
        substituted = substituted_decisions(flight)
        if planned.scheme.is_answered and substituted > 3:
            self.console.print(
                f"{planned.scheme.label}, seed {planned.seed}: {substituted} of {len(flight.decisions)} decisions were "
                "not the LLM's but taken in its place; the result says so",
                markup=False,
                highlight=False,
            )

    def _write(self, plan: ExperimentPlan) -> Result:
        from lab.experiments.findings import findings, tidy
        from lab.experiments.plots import draw

        notes = [f"{label} cannot fly: {why}" for label, why in self.grounded.items() if _concerns(plan, label)]
        result = findings(plan, self.setup, self.command_of(plan.experiment), self.store.load, notes)
        folder = self.out / plan.experiment.name
        with naming_out(folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / RESULT).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
            (folder / TABLE).write_text(tidy(result), encoding="utf-8")
            draw(result, folder)
        self.console.print(f"Wrote {folder / RESULT}, its CSV and figures", markup=False, highlight=False)
        return result


def _concerns(plan: ExperimentPlan, label: str) -> bool:
    return any(label == f"{flight.scheme.label} on {flight.site_name}" for flight in plan.flights)


def _order(planned: Planned) -> tuple[bool, bool, bool]:
    """The sort key for cheap flights first: policies, planners and bounds, edges without an LLM, edges with one."""
    return planned.scheme.asks_llm, planned.backing is not None, planned.plans


@contextmanager
def _progress(console: Console, total: int) -> Iterator[Callable[[Planned, float], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("flights, about {task.fields[left]} left; {task.fields[flight]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("Flying", total=total, left="?", flight="")
        printed_at, done = time.monotonic(), 0

        def advance(planned: Planned, left_s: float) -> None:
            nonlocal printed_at, done
            done += 1
            flight, left = f"{planned.scheme.name}, seed {planned.seed}", duration_text(left_s)
            progress.update(task, advance=1, left=left, flight=flight)
            if not console.is_terminal and time.monotonic() - printed_at > _REPORT_EVERY_S:
                printed_at = time.monotonic()
                console.print(f"{done} of {total} flights, about {left} left; {flight}", highlight=False)

        yield advance
