"""Fly what is missing, keep every flight at once, and write each experiment as soon as its flights are there."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from simulator.errors import UsageError
from simulator.experiments.edges import edge_for
from simulator.experiments.flight import FlightStore, Flown
from simulator.experiments.flying import CannotFly, commit, fly_here, fly_over
from simulator.experiments.measures import policys_instead
from simulator.experiments.pace import Pace, told
from simulator.experiments.plan import Experiment, Plan, Planned, Setup, plan
from simulator.experiments.result import Result
from simulator.records.run_folder import naming_out

FLIGHTS, RESULT, TABLE = "flights", "results.json", "results.csv"
# Where nobody watches a progress bar, a line this often.
_TELL_EVERY_S = 30.0


@dataclass
class Run:
    """One run of the command: what there is to fly, where to keep it, and what came of it.

    ``command_of`` is the command line that makes one experiment; ``workers`` processes fly what needs no edge.
    """

    setup: Setup
    out: Path
    command_of: Callable[[Experiment], str]
    console: Console
    workers: int = 1
    pace: Pace = field(default_factory=Pace)
    grounded: dict[str, str] = field(default_factory=dict)
    flown: int = 0

    def make(self, experiments: Sequence[Experiment]) -> list[Result]:
        """Make the experiments, from flights kept and flown.

        Raises:
            UsageError: the folder cannot be written.
            EdgeError: an edge died, or has no LLM though it should have one.
            KeyboardInterrupt: interrupted; what was flown is kept.
        """
        self.store = FlightStore(self.out / FLIGHTS)
        plans = self._plans(experiments)
        missing = self._missing(plans)
        waiting = {id(p): {f.key for f in p.flights} & missing.keys() for p in plans}
        self._tell_start(plans, missing)
        results = [self._write(p) for p in plans if not waiting[id(p)]]
        for key in self._fly(missing):
            for p in plans:
                if key in waiting[id(p)]:
                    waiting[id(p)].remove(key)
                    if not waiting[id(p)]:
                        results.append(self._write(p))
        return results

    def _plans(self, experiments: Sequence[Experiment]) -> list[Plan]:
        plans = [plan(experiment, self.setup) for experiment in experiments]
        empty = [p.experiment.name for p in plans if not p.flights]
        if len(empty) == len(plans):
            raise UsageError(f"experiment {', '.join(empty)}: every scheme of it asks an LLM; name one with --llm")
        if empty:
            self.console.print(f"Without an LLM there is nothing to fly for {', '.join(empty)}.", highlight=False)
        return [p for p in plans if p.flights]

    def _missing(self, plans: Sequence[Plan]) -> dict[str, Planned]:
        missing, there = {}, set()
        for planned in (flight for p in plans for flight in p.flights):
            if planned.key in there or planned.key in missing:
                continue
            flight = self.store.load(planned.key)
            if flight is None:
                missing[planned.key] = planned
            else:
                there.add(planned.key)
                self.pace.took(planned, flight.duration_s)
        return missing

    def _tell_start(self, plans: Sequence[Plan], missing: dict[str, Planned]) -> None:
        needed = {flight.key for p in plans for flight in p.flights}
        left = f"about {told(self.pace.left_s(missing.values()))}" if missing else "nothing to fly"
        self.console.print(
            f"{len(needed)} flights, {len(needed) - len(missing)} of them flown before; {left}.", highlight=False
        )

    def _fly(self, missing: dict[str, Planned]) -> Iterator[str]:
        """Fly them all, cheap ones first; yields each key when its flight is kept, or cannot be flown."""
        left = dict(sorted(missing.items(), key=lambda item: _order(item[1])))
        with _progress(self.console, len(left)) as tell:
            for planned, flight in self._flights(list(left.values())):
                del left[planned.key]
                self.flown += 1
                if flight is not None:
                    self.store.save(planned.key, flight)
                    self.pace.took(planned, flight.duration_s)
                    self._doubt(planned, flight)
                tell(planned, self.pace.left_s(left.values()))
                yield planned.key

    def _flights(self, flights: Sequence[Planned]) -> Iterator[tuple[Planned, Flown | None]]:
        yield from self._here([planned for planned in flights if planned.backing is None])
        for backing in dict.fromkeys(planned.backing for planned in flights if planned.backing is not None):
            name = "".join(c if c.isalnum() else "-" for c in Path(backing).stem)
            with edge_for(backing, self.setup.llm, self.out / f"edge-{name}.log", self.console) as edge:
                for planned in (p for p in flights if p.backing == backing):
                    yield planned, fly_over(edge, planned)

    def _here(self, flights: Sequence[Planned]) -> Iterator[tuple[Planned, Flown | None]]:
        apart = [planned for planned in flights if self.workers > 1 or planned.plans]
        for planned in (planned for planned in flights if planned not in apart):
            yield planned, self._landed(planned, lambda planned=planned: fly_here(planned))  # type: ignore[misc]
        if apart:
            with _workers(self.workers) as pool:
                futures = {pool.submit(fly_here, planned): planned for planned in apart}
                for future in as_completed(futures):
                    yield futures[future], self._landed(futures[future], future.result)

    def _landed(self, planned: Planned, fly: Callable[[], Flown]) -> Flown | None:
        try:
            return fly()
        except CannotFly as error:
            self.grounded.setdefault(f"{planned.scheme.label} on {planned.site_name}", str(error))
            return None

    def _doubt(self, planned: Planned, flight: Flown) -> None:
        instead = policys_instead(flight)
        if planned.scheme.is_answered and instead > 3:
            self.console.print(
                f"{planned.scheme.label}, seed {planned.seed}: {instead} of {len(flight.decisions)} decisions were not "
                "the LLM's but taken in its place; the result says so",
                markup=False,
                highlight=False,
            )

    def _write(self, made: Plan) -> Result:
        from simulator.experiments.findings import findings, tidy
        from simulator.experiments.plots import draw

        said = [f"{who} cannot fly: {why}" for who, why in self.grounded.items() if _concerns(made, who)]
        result = findings(made, self.setup, self.command_of(made.experiment), commit(), self.store.load, said)
        folder = self.out / made.experiment.name
        with naming_out(folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / RESULT).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
            (folder / TABLE).write_text(tidy(result), encoding="utf-8")
            draw(result, folder)
        self.console.print(f"Wrote {folder / RESULT}, its CSV and figures", markup=False, highlight=False)
        return result


def _concerns(made: Plan, who: str) -> bool:
    return any(who == f"{flight.scheme.label} on {flight.site_name}" for flight in made.flights)


def _order(planned: Planned) -> tuple[bool, bool, bool]:
    """Cheap first: policies, planners and bounds, edges without an LLM, edges with one."""
    return planned.scheme.asks_llm, planned.backing is not None, planned.plans


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes to fly in, ended at once when this one is interrupted.

    Planners need one even if it is alone: OR-Tools takes SIGINT for itself to search, and does not give it back.
    """
    # Forked children would inherit this process's threads and sockets.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_ignore_interrupts)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _ignore_interrupts() -> None:
    # Ctrl-C reaches every process of the terminal; the parent alone decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _progress(console: Console, total: int) -> Iterator[Callable[[Planned, float], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("flights, about {task.fields[left]} left; {task.fields[news]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("Flying", total=total, left="?", news="")
        told_at, done = time.monotonic(), 0

        def tell(planned: Planned, left_s: float) -> None:
            nonlocal told_at, done
            done += 1
            news = f"{planned.scheme.name}, seed {planned.seed}"
            progress.update(task, advance=1, left=told(left_s), news=news)
            if not console.is_terminal and time.monotonic() - told_at > _TELL_EVERY_S:
                told_at = time.monotonic()
                console.print(f"{done} of {total} flights, about {told(left_s)} left; {news}", highlight=False)

        yield tell
