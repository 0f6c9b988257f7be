"""``aicvds simulate``: fly one mission against an edge and leave its summary, decisions and report."""

from __future__ import annotations

import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import httpx
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from tyro.conf import FlagCreatePairsOff, arg

from shared.wire import Mode, Uplink
from simulator.client import EdgeClient
from simulator.commandline import (
    INTERRUPTED,
    check_between,
    check_deadline,
    check_seed,
    check_wait,
    checked_edge,
    command_main,
)
from simulator.record import (
    DECISIONS,
    FIGURES,
    REPORT,
    REQUESTS,
    SUMMARY,
    BadUse,
    BySource,
    DecisionLog,
    fresh_folder,
    naming_out,
    refuse_old_result,
    summarise,
    told_sources,
)
from simulator.requests import RequestLog, resolved
from simulator.site import Site, chosen_site
from simulator.uplink import LossyTransport

# The world and matplotlib take a second to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from simulator.metrics import FlightMetrics
    from simulator.mission import Choice, Flight, Pilot

API_KEY = "AICVDS_API_KEY"
# Without a deadline of our own the edge's applies, and it may be as long as the paper's step.
DEFAULT_TIMEOUT_S = 10.0
NETWORK_SLACK_S = 1.0
# A poll that nobody answers must not outlast the pause that it is part of by much.
SCOUT_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class Simulate:
    """Fly one mission against an edge and write what came of it.

    The UAVs fly the scenario's world step by step, ask the edge at every waypoint, and report what each decision
    cost. EOF and WQCS then fly the same world for comparison. Written to --out: summary.json,
    decisions.jsonl (one decision a line, written as they happen), report.html (open it in a browser) and, where an
    edge was asked, requests.jsonl (what it was asked, about 1 kB a decision with 10 sensors, for `aicvds replay`).

    Start an edge, then fly against it from another terminal:

      aicvds serve

      aicvds simulate --edge http://127.0.0.1:8000 --out runs/first

    No edge at hand:

      aicvds simulate --policy eof

    Your own pipeline:

      aicvds simulate --policy eof --world examples/pipeline_world

    An edge lost on the way: the UAVs decide on board with EOF, and before the next step wait up to --reconnect-s
    seconds for the edge to come back. Steps are not real time, so without a pause the mission would be over first.

    Ctrl-C stops the flight and still writes the report of what was flown. An edge that wants a key gets
    the one in the environment variable AICVDS_API_KEY. Exit code: 0 flown, 1 no edge, 2 bad use, 130 interrupted.
    """

    edge: Annotated[str | None, arg(metavar="URL")] = None
    """The edge's address, such as http://127.0.0.1:8000. Needed, unless --policy is a local one: that asks no edge."""
    scenario: Annotated[str | None, arg(metavar="NAME")] = None
    """A ready-made world: paper (10 sensors, 3 UAVs, 30 steps; the default), pipeline (sensors in a line), stress
    (weak link), dense (100 sensors, 10 UAVs) or lossy_uplink (a tenth of the requests lost)."""
    world: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """A world of your own, instead of --scenario: a folder with world.geojson (sensors, trajectories) and, if you
    like, scenario.toml (other numbers) and arrivals.csv (recorded traffic). examples/pipeline_world is one."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Of the world: sensors, queues, arrivals and starts, as far as they are not given. 0 to 4294967295; the same
    seed is the same world."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Waypoints to fly, 1 to 10000. Default: the world's (30 in every scenario)."""
    policy: Annotated[str, arg(metavar="NAME")] = "edge"
    """Who decides: edge, or with no edge at all eof (earliest overflow first), wqcs (weighted queue and
    channel), max_gain (highest channel gain), nearest (nearest neighbour), round_robin, random, mpc (a CP-SAT planner,
    extra `planner`), madqn or mappo (trained networks, extra `marl`)."""
    mode: Annotated[Mode | None, arg(metavar="MODE")] = None
    """How the edge decides: llm (the paper's method), guided (the LLM among other advisers), value (what its modules
    learned) or policy (the planner). Default: the edge's."""
    uplink: Annotated[Uplink, arg(metavar="full|delta|pruned")] = "full"
    """What a UAV sends: all, what changed (it is decided alike), or the k sensors that attention on board keeps."""
    deadline_ms: Annotated[int | None, arg(metavar="MS")] = None
    """Milliseconds that the edge may take for one decision, 10 to 60000. Default: the edge's own setting."""
    wait_s: Annotated[float, arg(metavar="S")] = 120.0
    """Seconds to wait for the edge and its LLM. One still loading its LLM then decides without it."""
    await_llm: Annotated[Literal["on", "off"], arg(metavar="on|off")] = "off"
    """on: an LLM that is out of reach is waited for too, as one that loads is."""
    reconnect_s: Annotated[float, arg(metavar="S")] = 10.0
    """Seconds, in all per outage, to wait in the air for a lost edge and its LLM, 0 to 3600; 0 never waits."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder to write to, made if missing. Default: runs/ and the mission's ID, such as runs/paper-0-1f6c09ab."""
    overwrite: Annotated[bool, FlagCreatePairsOff] = False
    """Write even where a mission's result is already."""
    metrics_port: Annotated[int, arg(metavar="0-65535")] = 0
    """Port on which Prometheus finds the flight's metrics while it lasts, and until it was there once more (20 s at
    most); 0: none."""
    metrics_host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address for that port; 0.0.0.0 for every interface. Whoever reaches it may read."""


def main(argv: list[str]) -> int:
    """Fly the mission that the command line describes; returns the exit code."""
    command = shlex.join(["aicvds", "simulate", *argv])
    return command_main(Simulate, "aicvds simulate", argv, lambda options, console: simulate(options, command, console))


def simulate(options: Simulate, command: str, console: Console) -> int:
    """Fly, write, print; returns the exit code.

    Raises:
        BadUse: the options make no mission, or the folder cannot be written.
        EdgeError: no edge answers as one.
    """
    site = chosen_site(options.scenario, options.world, options.steps)
    check(options)
    from simulator.metrics import FlightMetrics, served
    from simulator.mission import new_mission_id

    mission_id = new_mission_id(site.scenario, options.seed)
    job = Job(
        site=site,
        seed=options.seed,
        mission_id=mission_id,
        out=options.out or Path("runs") / mission_id,
        command=command,
        policy=options.policy,
        edge=options.edge if options.policy == "edge" else None,
        mode=options.mode,
        uplink=options.uplink,
        deadline_ms=options.deadline_ms,
        wait_s=options.wait_s,
        wait_out=("loading", "unavailable") if options.await_llm == "on" else ("loading",),
        reconnect_s=options.reconnect_s,
    )
    refuse_old_result(job.out, options.overwrite)
    metrics = FlightMetrics(site.scenario.steps)
    with served(metrics, options.metrics_host, options.metrics_port) as server:
        code = conduct(job, console, metrics=metrics)
        # All is written by now: Ctrl-C means only not to wait.
        if server is not None and code != INTERRUPTED:
            with console.status("Waiting until Prometheus has the last numbers"), suppress(KeyboardInterrupt):
                server.await_last_scrape()
    return code


def check(options: Simulate) -> None:
    """Raises ``BadUse`` for the first option that is out of its bounds."""
    from simulator.policies import POLICY_NAMES

    check_seed(options.seed)
    check_wait(options.wait_s)
    if options.policy not in ("edge", *POLICY_NAMES):
        raise BadUse(f"--policy {options.policy}: choose one of edge, {', '.join(POLICY_NAMES)}")
    check_deadline(options.deadline_ms)
    check_between("--reconnect-s", options.reconnect_s, 0, 3600)
    check_between("--metrics-port", options.metrics_port, 0, 65_535)
    if options.policy == "edge":
        checked_edge(options.edge)
    elif options.edge is not None:
        raise BadUse(f"--policy {options.policy} asks no edge, so --edge contradicts it; give one of the two")
    elif options.uplink != "full":
        raise BadUse(
            f"--policy {options.policy} asks no edge, so --uplink {options.uplink} means nothing; leave it out"
        )


@dataclass(frozen=True)
class Job:
    """One mission to conduct. ``policy`` is ``edge`` or a local policy's name; ``edge`` is ``None`` for those.

    ``wait_out`` are the LLM's states that are waited out before take-off, ``wait_s`` seconds at most.
    """

    site: Site
    seed: int
    mission_id: str
    out: Path
    command: str
    policy: str = "edge"
    edge: str | None = None
    mode: Mode | None = None
    uplink: Uplink = "full"
    deadline_ms: int | None = None
    wait_s: float = 120.0
    wait_out: tuple[str, ...] = ("loading",)
    reconnect_s: float = 0.0


def conduct(
    job: Job, console: Console, alive: Callable[[], None] = lambda: None, metrics: FlightMetrics | None = None
) -> int:
    """Wait for the edge, fly, compare, write and print; returns the exit code.

    ``alive`` is called while waiting and raises if there is nothing to wait for; ``metrics`` hears of the flight.

    Raises:
        BadUse: the folder cannot be written.
        EdgeError: no edge answers as one, before take-off.
    """
    from simulator.mission import EdgePilot, LocalPilot

    if job.edge is None:
        fresh_folder(job.out)
        flight = _fly(job, LocalPilot(job.policy, job.site.scenario, job.seed), console, _News(metrics))
        return _conclude(job, flight, None, None, console)
    with _client(job, job.edge) as ground, _client(job, job.edge, airborne=True) as radio, _scout(job.edge) as scout:
        model = await_edge(ground, job.wait_s, console, alive, job.wait_out)
        news = _News(metrics)
        pilot = EdgePilot(
            radio, job.mission_id, job.site.scenario, job.seed, mode=job.mode, deadline_ms=job.deadline_ms,
            scout=scout, reconnect_s=job.reconnect_s, on_wait=news.waiting,
        )  # fmt: skip
        made = ground.put_mission(job.mission_id, pilot.spec)
        fresh_folder(job.out)
        with naming_out(job.out):
            requests = RequestLog(job.out / REQUESTS, resolved(pilot.spec, made))
        with requests:
            pilot.on_request = requests.append
            flight = _fly(job, pilot, console, news)
    code = _conclude(job, flight, made.mode, model, console)
    if pilot.last_error is not None:
        unanswered = len(flight.decisions) - pilot.answered
        print(
            f"{unanswered} decisions were taken on board. The edge's last failure: {pilot.last_error}", file=sys.stderr
        )
    return code or (1 if flight.decisions and not pilot.answered else 0)


def _client(job: Job, edge: str, airborne: bool = False) -> EdgeClient:
    """The fleet's radio, or the wire on the ground, which loses nothing whatever the scenario."""
    timeout_s = DEFAULT_TIMEOUT_S if job.deadline_ms is None else job.deadline_ms / 1000 + NETWORK_SLACK_S
    transport = None
    if airborne and (job.site.scenario.uplink_drop or job.site.scenario.uplink_jitter_ms):
        transport = LossyTransport(
            httpx.HTTPTransport(),
            drop=job.site.scenario.uplink_drop,
            jitter_ms=job.site.scenario.uplink_jitter_ms,
            seed=job.seed,
        )
    key = os.environ.get(API_KEY) or None
    return EdgeClient(edge, timeout_s=timeout_s, api_key=key, seed=job.seed, transport=transport, uplink=job.uplink)


def _scout(edge: str) -> EdgeClient:
    return EdgeClient(edge, timeout_s=SCOUT_TIMEOUT_S, attempts=1, api_key=os.environ.get(API_KEY) or None)


def await_edge(
    ground: EdgeClient,
    wait_s: float,
    console: Console,
    alive: Callable[[], None] = lambda: None,
    wait_out: tuple[str, ...] = ("loading",),
) -> str | None:
    """Wait until the edge can decide and its LLM is none of ``wait_out``; returns the LLM's name, if it has one.

    Raises:
        EdgeError: no edge answers as one within ``wait_s`` seconds.
    """
    with console.status(f"Waiting for the edge at {ground.base_url}") as status:

        def waiting(cause: str) -> None:
            alive()
            status.update(f"Waiting for the edge at {ground.base_url}: {escape(cause)}")

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


class _News:
    """What the progress line says: the packets lost and the deciders so far, and what is being waited for.

    ``metrics`` hears of the flight too.
    """

    def __init__(self, metrics: FlightMetrics | None) -> None:
        self._metrics = metrics
        self._update: Callable[[str], None] = lambda text: None
        self._lost = 0
        self._sources: Counter[str] = Counter()

    def tell(self, update: Callable[[str], None]) -> None:
        """Say it with ``update`` from now on."""
        self._update = update

    def waiting(self, cause: str) -> None:
        """The edge is lost, and the fleet waits for it."""
        self._update(f"waiting for the edge: {escape(cause)}")

    def decided(self, choice: Choice) -> None:
        """One UAV knows where to go."""
        if self._metrics is not None:
            self._metrics.decided(choice)
        self._sources[choice.source] += 1
        trip = f", {choice.exchange.rtt_ms:.0f} ms" if choice.exchange else ""
        self._update(f"{self._lost} lost; {choice.source} decides{trip}")

    def stepped(self, flight: Flight) -> None:
        """The whole fleet has flown a step."""
        if self._metrics is not None:
            self._metrics.stepped(flight)
        self._lost += flight.tally[-1].lost_packets
        self._update(f"{self._lost} lost; {told_sources(BySource(**self._sources))}")


def _fly(job: Job, pilot: Pilot, console: Console, news: _News) -> Flight:
    from simulator.mission import fly

    with naming_out(job.out):
        log = DecisionLog(job.out / DECISIONS)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=12),
        MofNCompleteColumn(),
        TextColumn("steps"),
        TextColumn("{task.fields[news]}"),
        TimeElapsedColumn(),
    )
    with log, Progress(*columns, console=console) as progress:
        task = progress.add_task("Flying", total=job.site.scenario.steps, news="")
        news.tell(lambda text: progress.update(task, news=text))

        def stepped(flight: Flight) -> None:
            progress.advance(task)
            news.stepped(flight)

        flight = fly(job.site, pilot, job.seed, log, news.decided, stepped)
    if flight.interrupted:
        console.print(f"interrupted after {flight.steps_flown} steps; writing what was flown", highlight=False)
    return flight


def _conclude(job: Job, flight: Flight, mode: str | None, model: str | None, console: Console) -> int:
    from simulator.mission import baselines

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
    summary = summarise(facts, flight.decisions, tallies)
    with console.status("Drawing the report"), naming_out(job.out):
        (job.out / SUMMARY).write_text(summary.model_dump_json(indent=2) + "\n", encoding="utf-8")
        from simulator.report import show, write_report

        write_report(job.out / REPORT, summary, job.site.scenario, flight.decisions, tallies, flight.sensor_xy)
    show(summary, console)
    for name in (SUMMARY, DECISIONS, REPORT, FIGURES, *((REQUESTS,) if job.edge else ())):
        console.print(f"Wrote {job.out / name}", markup=False, highlight=False, soft_wrap=True)
    return INTERRUPTED if flight.interrupted else 0
