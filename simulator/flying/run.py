"""One mission from take-off to its report: wait for the edge, fly, summarise, write."""

from __future__ import annotations

import os
import secrets
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn

from shared.guidance import GuidanceAnswer
from shared.missions import MissionStatus
from shared.scenario import Scenario
from shared.schemas import LLM_MODES, MissionSpec, Mode, Uplink
from simulator.cli.running import INTERRUPTED
from simulator.client import EdgeClient
from simulator.client.lossy_transport import LossyTransport
from simulator.errors import EdgeError, EdgeRefused, UsageError
from simulator.records.decision_log import DecisionLog
from simulator.records.operator import Operator, recounted
from simulator.records.request_log import RequestLog, resolved
from simulator.records.run_folder import DECISIONS, FIGURES, REPORT, REQUESTS, SUMMARY, fresh_folder, naming_out
from simulator.records.summary import BySource, Summary, Tally, sources_text, summarise
from simulator.sites.site import Site

# The world and matplotlib take a second to import; `--help` and usage errors do without them.
if TYPE_CHECKING:
    from simulator.flying.flight import Flight
    from simulator.flying.flight_metrics import FlightMetrics
    from simulator.flying.pilots import Choice, Pilot

API_KEY = "AICVDS_API_KEY"
# Without a requested deadline the edge's default applies, which may be as long as the paper's step.
DEFAULT_TIMEOUT_S = 10.0
NETWORK_SLACK_S = 1.0
# The timeout of a readiness probe during an outage, short beside the wait for the edge.
PROBE_TIMEOUT_S = 2.0
# Seconds of search for the bound on a mission's losses. Scenario `paper` takes about one.
BOUND_S = 10.0


def new_mission_id(scenario: Scenario, seed: int) -> str:
    """A new, unique ID such as ``paper-0-1f6c09ab``."""
    return f"{scenario.name}-{seed}-{secrets.token_hex(4)}"


@dataclass(frozen=True)
class Job:
    """One mission to conduct.

    ``policy`` is ``edge`` or a local policy's name, and then ``edge`` is ``None``. A ``named`` mission may exist at the
    edge before the flight. ``note`` is the operator's. Before take-off the mission waits,
    at most ``wait_s`` seconds, while the LLM's state is one of ``wait_out``. After the flight the bound on its losses
    is searched for ``bound_s`` seconds at most; 0 searches none. ``reference`` is a mode without an LLM in which the
    same edge flies the same world once more, after a mission whose mode has one.
    """

    site: Site
    seed: int
    mission_id: str
    out: Path
    command: str
    policy: str = "edge"
    edge: str | None = None
    mode: Mode | None = None
    note: str | None = None
    named: bool = False
    uplink: Uplink = "full"
    deadline_ms: int | None = None
    wait_s: float = 120.0
    wait_out: tuple[str, ...] = ("loading",)
    reconnect_s: float = 0.0
    bound_s: float = BOUND_S
    reference: Mode | None = None


def conduct(
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

    if job.edge is None:
        fresh_folder(job.out)
        flight = _fly(job, LocalPilot(job.policy, job.site.scenario, job.seed), console, _ProgressText(metrics))
        return _conclude(job, flight, None, None, {}, console)
    lossy = _radio_link(job.site.scenario, job.seed)
    with _client(job, job.edge) as ground, _client(job, job.edge, lossy) as radio, _probe(job.edge) as probe:
        model = await_edge(ground, job.wait_s, console, alive, job.wait_out)
        progress = _ProgressText(metrics)
        pilot = EdgePilot(
            radio, job.mission_id, job.site.scenario, job.seed, mode=job.mode, note=job.note,
            deadline_ms=job.deadline_ms,
            probe=probe, reconnect_s=job.reconnect_s, on_wait=progress.waiting,
        )  # fmt: skip
        created = begun_mission(ground, job, pilot.spec)
        watched = f"{job.edge}/?mission={job.mission_id}"
        console.print(f"Mission {job.mission_id}; watch it at {watched}", markup=False, highlight=False, soft_wrap=True)
        if job.note is not None:
            console.print("The edge obeys the note once you confirm it on that page.", highlight=False, soft_wrap=True)
        fresh_folder(job.out)
        with naming_out(job.out):
            requests = RequestLog(job.out / REQUESTS, resolved(pilot.spec, created))
        with requests:
            pilot.on_request = requests.append
            flight = _fly(job, pilot, console, progress)
        operator = _operator(probe, job.mission_id, flight)
        again = _reference(job, ground, console) if created.mode in LLM_MODES and not flight.interrupted else None
    extra = {"operator": operator, "without_llm": again}
    code = _conclude(job, flight, created.mode, model, extra, console)
    if pilot.last_error is not None:
        unanswered = len(flight.decisions) - pilot.answered
        print(
            f"{unanswered} decisions were taken on board. The edge's last failure: {pilot.last_error}", file=sys.stderr
        )
    return code or (1 if flight.decisions and not pilot.answered else 0)


def begun_mission(ground: EdgeClient, job: Job, spec: MissionSpec) -> MissionStatus:
    """The mission at the edge: made now, or, where the job names one that is there, that one.

    Raises:
        UsageError: the mission that is there has another world or mode, or has flown already.
        EdgeError: the edge refuses.
    """
    there = _existing(ground, job.mission_id) if job.named else None
    if there is None:
        return ground.put_mission(job.mission_id, spec)
    name = f"--mission {job.mission_id}: the edge has this mission"
    if there.decisions:
        raise UsageError(f"{name}, with {there.decisions} decisions already; choose another ID, or DELETE it there")
    if there.scenario.model_copy(update={"steps": job.site.scenario.steps}) != job.site.scenario:
        raise UsageError(f"{name}, for another world ({there.scenario.name}); give that --scenario or --world")
    # A flight may end earlier.
    if there.scenario.steps < job.site.scenario.steps:
        raise UsageError(f"{name}, of {there.scenario.steps} steps; give at most --steps {there.scenario.steps}")
    if job.mode is not None and there.mode != job.mode:
        raise UsageError(f"{name}, in mode {there.mode}; leave out --mode {job.mode}, or choose another ID")
    if job.note is not None and there.note != job.note:
        ground.answer_guidance(job.mission_id, GuidanceAnswer(note=job.note))
    return there


def _existing(ground: EdgeClient, mission_id: str) -> MissionStatus | None:
    try:
        return ground.mission(mission_id)
    except EdgeRefused as refused:
        if refused.status == 404:
            return None
        raise


def _radio_link(scenario: Scenario, seed: int) -> LossyTransport | None:
    """The transport of the scenario's radio link; ``None`` for a lossless one."""
    if not scenario.uplink_drop and not scenario.uplink_jitter_ms:
        return None
    inner = httpx.HTTPTransport()
    return LossyTransport(inner, drop=scenario.uplink_drop, jitter_ms=scenario.uplink_jitter_ms, seed=seed)


def _client(job: Job, edge: str, transport: httpx.BaseTransport | None = None) -> EdgeClient:
    """A client of the edge with the job's deadline and uplink; without ``transport`` its link is lossless."""
    timeout_s = DEFAULT_TIMEOUT_S if job.deadline_ms is None else job.deadline_ms / 1000 + NETWORK_SLACK_S
    key = os.environ.get(API_KEY) or None
    return EdgeClient(edge, timeout_s=timeout_s, api_key=key, seed=job.seed, transport=transport, uplink=job.uplink)


def _probe(edge: str) -> EdgeClient:
    return EdgeClient(edge, timeout_s=PROBE_TIMEOUT_S, attempts=1, api_key=os.environ.get(API_KEY) or None)


def await_edge(
    ground: EdgeClient,
    wait_s: float,
    console: Console,
    alive: Callable[[], None] = lambda: None,
    wait_out: tuple[str, ...] = ("loading",),
) -> str | None:
    """Wait until the edge can decide and its LLM's state is none of ``wait_out``; returns the LLM's name, if any.

    Raises:
        EdgeError: no edge is ready within ``wait_s`` seconds.
    """
    with console.status(f"Waiting for the edge at {ground.base_url}") as status:

        def waiting(cause: str) -> None:
            alive()
            status.update(f"Waiting for the edge at {ground.base_url} (`aicvds serve` starts one): {escape(cause)}")

        readiness = ground.wait_ready(wait_s, wait_out, on_wait=waiting)
        alive()
    if readiness.llm == "ready":
        console.print(f"The edge is ready; its LLM is {escape(readiness.model or 'unnamed')}.")
    elif readiness.llm == "off":
        console.print("The edge is ready, without an LLM.")
    else:
        detail = f" ({readiness.detail})" if readiness.detail else ""
        console.print(f"The edge is ready; its LLM is {readiness.llm}{escape(detail)}, so its policy decides.")
    return readiness.model


class _ProgressText:
    """The text of the progress line: packets lost and sources so far, or the cause of a wait.

    It also forwards decisions and steps to ``metrics``.
    """

    def __init__(self, metrics: FlightMetrics | None) -> None:
        self._metrics = metrics
        self._update: Callable[[str], None] = lambda text: None
        self._lost = 0
        self._sources: Counter[str] = Counter()

    def show_with(self, update: Callable[[str], None]) -> None:
        """Display the text by calling ``update``."""
        self._update = update

    def waiting(self, cause: str) -> None:
        """Show that the fleet waits for a lost edge."""
        self._update(f"waiting for the edge: {escape(cause)}")

    def decided(self, choice: Choice) -> None:
        """Count and show a decision."""
        if self._metrics is not None:
            self._metrics.decided(choice)
        self._sources[choice.source] += 1
        trip = f", {choice.exchange.rtt_ms:.0f} ms" if choice.exchange else ""
        self._update(f"{self._lost} lost; {choice.source} decides{trip}")

    def stepped(self, flight: Flight) -> None:
        """Count and show a step of the whole fleet."""
        if self._metrics is not None:
            self._metrics.stepped(flight)
        self._lost += flight.tally[-1].lost_packets
        self._update(f"{self._lost} lost; {sources_text(BySource(**self._sources))}")


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
        text.show_with(lambda shown: progress.update(task, text=shown))

        def stepped(flight: Flight) -> None:
            progress.advance(task)
            text.stepped(flight)

        flight = fly(job.site, pilot, job.seed, log, text.decided, stepped)
    if flight.interrupted:
        console.print(f"interrupted after {flight.steps_flown} steps; writing their results", highlight=False)
    return flight


def _reference(job: Job, edge: EdgeClient, console: Console) -> int | None:
    """The packets that the same edge loses in the same world in the job's reference mode; ``None`` if it fails."""
    from simulator.flying.flight import fly
    from simulator.flying.pilots import EdgePilot

    if job.reference is None:
        return None
    mission_id = f"{job.mission_id}-{job.reference}"
    pilot = EdgePilot(edge, mission_id, job.site.scenario, job.seed, mode=job.reference, deadline_ms=job.deadline_ms)
    with Progress(*_columns(), console=console) as progress:
        task = progress.add_task(f"Flying again, mode {job.reference}", total=job.site.scenario.steps, text="")

        def stepped(flight: Flight) -> None:
            progress.advance(task)

        try:
            edge.put_mission(mission_id, pilot.spec)
        except EdgeError:
            return None
        flight = fly(job.site, pilot, job.seed, on_step=stepped)
    if flight.interrupted or pilot.answered < len(flight.decisions):
        return None
    return sum(tally.lost_packets for tally in flight.tally)


def _operator(probe: EdgeClient, mission_id: str, flight: Flight) -> Operator | None:
    """The operator's part in the flight; ``None`` if there was none, or the edge that knows it is gone."""
    try:
        told, status = probe.guidance(mission_id), probe.mission(mission_id)
    except EdgeError:
        return None
    orders = status.deadlines or []
    if told.note is None and told.obeyed_in_words is None and not orders:
        return None
    deadlines = recounted(orders, flight.decisions, flight.steps_flown)
    return Operator(note=told.note, orders=told.obeyed_in_words, deadlines=deadlines)


def _bounded(job: Job, flight: Flight, summary: Summary, console: Console) -> Summary:
    """The summary with the bound on the losses, unless none is wanted."""
    if not job.bound_s:
        return summary
    from simulator.flying.mission_bound import mission_bound

    with console.status("Searching for the least that could have been lost"):
        bound = mission_bound(job.site, job.seed, flight.steps_flown, job.bound_s)
    known = {"bound_missing": bound} if isinstance(bound, str) else {"bound": bound}
    return summary.model_copy(update=known)


def _conclude(
    job: Job, flight: Flight, mode: str | None, model: str | None, extra: Mapping[str, Any], console: Console
) -> int:
    """Summarise, with these further fields of the summary, write and print; returns the exit code."""
    from simulator.flying.rollout import baselines

    flown_by = "aic_vds" if job.policy == "edge" else job.policy
    others = baselines(job.site, job.seed, flight.steps_flown)
    tallies = {flown_by: flight.tally, **{name: tally for name, tally in others.items() if name != flown_by}}
    facts = flight.facts(
        policy=job.policy,
        edge=job.edge,
        uplink=job.uplink if job.edge else None,
        mission_id=job.mission_id,
        mode=mode,
        model=model,
        deadline_ms=job.deadline_ms,
        command=job.command,
    )
    flown = summarise(facts, flight.decisions, tallies).model_copy(update=extra)
    summary = _bounded(job, flight, flown, console)
    write_results(job.out, summary, flight, tallies, console)
    return INTERRUPTED if flight.interrupted else 0


def write_results(
    out: Path, summary: Summary, flight: Flight, tallies: Mapping[str, Sequence[Tally]], console: Console
) -> None:
    """Write a flight's summary and report beside its log, and print its outcome and the files' names.

    Raises:
        UsageError: the folder cannot be written.
    """
    with console.status("Drawing the report"), naming_out(out):
        (out / SUMMARY).write_text(summary.model_dump_json(indent=2) + "\n", encoding="utf-8")
        from simulator.reporting.html_report import write_report
        from simulator.reporting.terminal_table import show

        world = (flight.sensor_xy, flight.track)
        write_report(out / REPORT, summary, flight.scenario, flight.decisions, tallies, *world)
    show(summary, console)
    for name in (SUMMARY, DECISIONS, REPORT, FIGURES, *((REQUESTS,) if summary.edge else ())):
        console.print(f"Wrote {out / name}", markup=False, highlight=False, soft_wrap=True)
