"""One mission from take-off to its report: wait for the edge, fly, summarise, write."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

from shared.client.edge_client import EdgeClient
from shared.client.errors import EdgeError
from shared.wire.schemas import LLM_MODES, Mode
from simulator.errors import INTERRUPTED
from simulator.flying.edge_session import await_edge, create_or_check_mission, job_client, probe_client, radio_link
from simulator.flying.job import EDGE_MODE, Job
from simulator.records.flight import Flight
from simulator.records.mission_logs import DecisionLog, RequestLog, with_edge_defaults
from simulator.records.operator import OperatorRecord, recount_deadlines
from simulator.records.run_folder import DECISIONS, REQUESTS, fresh_folder, naming_out
from simulator.records.summary import BySource, Summary, sources_text, summarise
from simulator.reporting.results import write_results

# The world and matplotlib take a second to import; `--help` and usage errors do without them.
if TYPE_CHECKING:
    from simulator.flying.flight_metrics import FlightMetrics
    from simulator.flying.pilots import Pilot, PilotChoice
    from simulator.world.observation import StepTally


def run_mission(
    job: Job, console: Console, alive: Callable[[], None] = lambda: None, metrics: FlightMetrics | None = None
) -> int:
    """Wait for the edge, fly, compare, write and print; returns the exit code.

    ``alive`` is called during the wait, and raises if the edge's process has ended. ``metrics`` counts the decisions
    and steps of the flight.

    Raises:
        UsageError: the folder cannot be written.
        EdgeError: no edge is ready before take-off.
    """
    from simulator.flying.pilots import EdgePilot, LocalPilot

    if job.edge is None or job.policy != "edge":
        fresh_folder(job.out)
        flight = _fly(job, LocalPilot(job.policy, job.site.scenario, job.seed), console, _ProgressText(metrics))
        return _write_results(job, flight, _others(job, job.against, flight, console, alive), None, None, {}, console)
    lossy = radio_link(job.site.scenario, job.seed)
    with (
        job_client(job, job.edge) as ground,
        job_client(job, job.edge, lossy) as radio,
        probe_client(job.edge) as probe,
    ):
        model = await_edge(ground, job.wait_s, console, alive, job.wait_out)
        progress = _ProgressText(metrics)
        pilot = EdgePilot(
            radio, job.mission_id, job.site.scenario, job.seed, mode=job.mode, note=job.note,
            deadline_ms=job.deadline_ms,
            probe=probe, reconnect_s=job.reconnect_s, on_wait=progress.on_wait,
        )  # fmt: skip
        pilot.spec = job.site.named(pilot.spec)
        created = create_or_check_mission(ground, job, pilot.spec)
        watched = f"{job.edge}/?mission={job.mission_id}"
        console.print(f"Mission {job.mission_id}; watch it at {watched}", markup=False, highlight=False, soft_wrap=True)
        if job.note is not None:
            console.print("The edge obeys the note once you confirm it on that page.", highlight=False, soft_wrap=True)
        fresh_folder(job.out)
        with naming_out(job.out):
            requests = RequestLog(job.out / REQUESTS, with_edge_defaults(pilot.spec, created))
        with requests:
            pilot.on_request = requests.append
            flight = _fly(job, pilot, console, progress)
        operator = _operator(probe, job.mission_id, flight)
        reference = [f"{EDGE_MODE}{job.reference}"] if job.reference and created.mode in LLM_MODES else []
        others = _others(job, [*reference, *job.against], flight, console, alive)
        again = others.pop(reference[0], None) if reference else None
    extra = {"operator": operator, "without_llm": None if again is None else sum(t.lost_packets for t in again)}
    code = _write_results(job, flight, others, created.mode, model, extra, console)
    if pilot.last_error is not None:
        unanswered = sum(decision.source == "onboard" for decision in flight.decisions)
        taken = f"{unanswered} decisions were taken on board. " if unanswered else ""
        print(f"{taken}The edge's last failure: {pilot.last_error}", file=sys.stderr)
    return code or (1 if flight.decisions and not pilot.answered else 0)


class _ProgressText:
    """The text of the progress line: packets lost and sources so far, or the cause of a wait.

    It calls ``update`` with each new text, and forwards decisions and steps to ``metrics``.
    """

    def __init__(self, metrics: FlightMetrics | None) -> None:
        self._metrics = metrics
        self.update: Callable[[str], None] = lambda text: None
        self._lost = 0
        self._sources: Counter[str] = Counter()

    def on_wait(self, cause: str) -> None:
        """Show that the fleet waits for a lost edge."""
        self.update(f"waiting for the edge: {escape(cause)}")

    def on_decision(self, choice: PilotChoice) -> None:
        """Count and show a decision."""
        if self._metrics is not None:
            self._metrics.count_decision(choice)
        self._sources[choice.source] += 1
        trip = f", {choice.exchange.rtt_ms:.0f} ms" if choice.exchange else ""
        self.update(f"{self._lost} lost; {choice.source} decides{trip}")

    def on_step(self, flight: Flight) -> None:
        """Count and show a step of the whole fleet."""
        if self._metrics is not None:
            self._metrics.count_step(flight)
        self._lost += flight.tally[-1].lost_packets
        self.update(f"{self._lost} lost; {sources_text(BySource(**self._sources))}")


def _columns() -> tuple[ProgressColumn, ...]:
    return (
        TextColumn("{task.description}"),
        BarColumn(bar_width=12),
        MofNCompleteColumn(),
        TextColumn("steps"),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
    )


def _fly(job: Job, pilot: Pilot, console: Console, text: _ProgressText) -> Flight:
    from simulator.flying.flight import fly

    with naming_out(job.out):
        log = DecisionLog(job.out / DECISIONS)
    with log, Progress(*_columns(), console=console) as progress:
        task = progress.add_task("Flying", total=job.site.scenario.steps, text="")
        text.update = lambda shown: progress.update(task, text=shown)
        began = time.monotonic()

        def stepped(flight: Flight) -> None:
            progress.advance(task)
            text.on_step(flight)
            if job.pace is not None:
                due = began + flight.steps_flown * job.site.scenario.step_s / job.pace
                time.sleep(max(0.0, due - time.monotonic()))

        flight = fly(job.site, pilot, job.seed, log, text.on_decision, stepped)
    if flight.interrupted:
        console.print(f"interrupted after {flight.steps_flown} steps; writing their results", highlight=False)
    return flight


def _fly_again(job: Job, mode: Mode, edge: EdgeClient, console: Console) -> list[StepTally]:
    """The tallies of the same world flown in another mode; raises ``EdgeError`` unless the edge decides all of it."""
    from simulator.flying.flight import fly
    from simulator.flying.pilots import EdgePilot

    mission_id = f"{job.mission_id}-{mode}"
    pilot = EdgePilot(edge, mission_id, job.site.scenario, job.seed, mode=mode, deadline_ms=job.deadline_ms)
    with Progress(*_columns(), console=console) as progress:
        task = progress.add_task(f"Flying again, mode {mode}", total=job.site.scenario.steps, text="")
        edge.put_mission(mission_id, pilot.spec)
        flight = fly(job.site, pilot, job.seed, on_step=lambda _: progress.advance(task))
    if flight.interrupted:
        raise KeyboardInterrupt
    if pilot.answered < len(flight.decisions):
        raise EdgeError(f"{len(flight.decisions) - pilot.answered} decisions were taken on board, {pilot.last_error}")
    return flight.tally


def _others(
    job: Job, names: Sequence[str], flight: Flight, console: Console, alive: Callable[[], None]
) -> dict[str, list[StepTally]]:
    """The tallies of these policies, over the steps flown, without those that fail and all after an interrupt."""
    from simulator.flying.flight import baselines

    flown: dict[str, list[StepTally]] = {}
    for name in names:
        try:
            if not name.startswith(EDGE_MODE):
                flown |= baselines(job.site, job.seed, flight.steps_flown, [name])
            elif job.edge is not None and not flight.interrupted:
                with job_client(job, job.edge) as edge:
                    await_edge(edge, job.wait_s, console, alive, job.wait_out)
                    tally = _fly_again(job, cast(Mode, name.removeprefix(EDGE_MODE)), edge, console)
                flown[name] = tally[: flight.steps_flown]
        except Exception as error:  # A user's own policy may raise anything.
            print(f"{name} was not flown: {str(error) or type(error).__name__}", file=sys.stderr)
        except KeyboardInterrupt:
            print(f"{name} was not flown to its end: interrupted", file=sys.stderr)
            break
    return flown


def _operator(probe: EdgeClient, mission_id: str, flight: Flight) -> OperatorRecord | None:
    """The operator's part in the flight; ``None`` if there was none, or the edge that knows it is gone."""
    try:
        guidance, status = probe.guidance(mission_id), probe.mission(mission_id)
    except (EdgeError, KeyboardInterrupt):
        return None
    in_force = [
        one for one in guidance.orders if one.since_step < flight.steps_flown and one.until_step != one.since_step
    ]
    if guidance.note is None and not in_force:
        return None
    deadlines = recount_deadlines(status.deadlines or [], flight.decisions, flight.steps_flown)
    return OperatorRecord(in_force=in_force, deadlines=deadlines)


def _with_bound(job: Job, flight: Flight, summary: Summary, console: Console) -> Summary:
    """The summary with the bound on the losses, unless none is wanted."""
    if not job.bound_s:
        return summary
    from simulator.bound.clairvoyant_bound import mission_bound

    with console.status("Searching for the least that could have been lost"):
        bound = mission_bound(job.site, job.seed, flight.steps_flown, job.bound_s)
    known = {"bound_missing": bound} if isinstance(bound, str) else {"bound": bound}
    return summary.model_copy(update=known)


def _write_results(
    job: Job,
    flight: Flight,
    others: Mapping[str, Sequence[StepTally]],
    mode: str | None,
    model: str | None,
    extra: Mapping[str, Any],
    console: Console,
) -> int:
    """Summarise, with these further fields of the summary, write and print; returns the exit code."""
    flown_by = "aic_vds" if job.policy == "edge" else job.policy
    tallies = {flown_by: flight.tally, **{name: tally for name, tally in others.items() if name != flown_by}}
    facts = flight.facts(
        policy=job.policy,
        edge=job.edge if job.policy == "edge" else None,
        uplink=job.uplink if job.policy == "edge" else None,
        mission_id=job.mission_id,
        mode=mode,
        model=model,
        deadline_ms=job.deadline_ms,
        command=job.command,
    )
    flown = summarise(facts, flight.decisions, tallies).model_copy(update={"names": job.site.names, **extra})
    write_results(job.out, _with_bound(job, flight, flown, console), flight, tallies, console)
    return INTERRUPTED if flight.interrupted else 0
