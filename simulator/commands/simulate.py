"""``aicvds simulate``: fly one mission against an edge and leave its summary, decisions and report."""

import shlex
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, arg

from shared.wire.schemas import Mode, Uplink
from simulator.commands.options import (
    check_between,
    check_deadline,
    check_mission,
    check_note,
    check_seed,
    check_wait,
    edge_from_option,
    site_from_options,
)
from simulator.commands.running import command_main
from simulator.errors import INTERRUPTED, UsageError
from simulator.flying.job import BOUND_S, Job, new_mission_id
from simulator.flying.run import run_mission
from simulator.records.run_folder import refuse_old_result


@dataclass(frozen=True)
class Simulate:
    """Fly one mission against an edge and write its results.

    The UAVs fly the scenario's world step by step, ask the edge for a decision at every waypoint, and report the cost
    of each decision. EOF and WQCS then fly the same world for comparison. Written to --out: summary.json,
    decisions.jsonl (one decision a line, written at once), report.html (open it in a browser) and, with an edge,
    requests.jsonl (the requests, about 1 kB a decision with 10 sensors, for `aicvds replay`).

    Start an edge, then fly against it from another terminal:

      aicvds serve

      aicvds simulate --edge http://127.0.0.1:8000 --out runs/first

    Without an edge:

      aicvds simulate --policy eof

    Your own pipeline:

      aicvds simulate --policy eof --world examples/pipeline_world

    If the edge is lost during the flight, the UAVs collect from the longest queue in reach, and before the next step
    wait up to --reconnect-s seconds for the edge to come back. Steps are not real time, so without this pause the
    mission would end first.

    Ctrl-C stops the flight and still writes the report of the steps flown. The environment variable AICVDS_API_KEY has
    the key for an edge that needs one. Exit code: 0 flown, 1 no edge, 2 bad use, 130 interrupted.
    """

    edge: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """The edge's address, such as http://127.0.0.1:8000. Required, unless --policy is a local one."""
    scenario: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """A ready-made world: paper (10 sensors, 3 UAVs, 30 steps; the default), pipeline (sensors in a line), stress
    (weak link), dense (100 sensors, 10 UAVs) or lossy_uplink (a tenth of the requests lost). In the other six the world
    differs from the edge's model: shadowed (links 8 dB off), fading, bursty (arrivals), windy, faulty (dead radios, a
    UAV gone, half of the rate lost) and field (all of it, mild)."""
    world: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """A world of your own, instead of --scenario: a folder with world.geojson (sensors, trajectories) and, optionally,
    scenario.toml (other numbers), arrivals.csv (recorded traffic) and gains.csv (recorded links).
    examples/pipeline_world is one."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the world, 0 to 4294967295: it draws the sensors, queues, arrivals and starts that are not given. The
    same seed gives the same world."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Waypoints to fly, 1 to 10000, but no more than a mission that is at the edge has. Default: the world's (30 in
    every scenario)."""
    policy: Annotated[str, arg(metavar="NAME")] = "edge"
    """The decider: edge, or without an edge the paper's eof (earliest overflow first) or wqcs (queue times rate), each
    also as NAME_coordinated (UAVs leave out the sensors taken in the step), longest_queue, queue_and_channel, max_gain
    (highest channel gain), nearest (nearest neighbour), round_robin, random, mpc (a planner, extra `planner`),
    or a class of your own as MODULE:CLASS."""
    mode: Annotated[Mode | None, arg(metavar="MODE", help_behavior_hint="")] = None
    """The edge's mode: llm (the paper's method), guided (the LLM among other advisers), value (the learned modules) or
    policy (the planner). Default: the edge's."""
    mission: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """The mission's ID at the edge: of a new mission, or of one that was made there for this world and has not flown.
    Default: a new one, such as paper-0-1f6c09ab."""
    note: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="")] = None
    """The operator's note in plain words, at most 280 characters. The flight begins at once; the edge obeys the note
    once it is confirmed, on the mission page or by POST /missions/ID/guidance. To confirm it before take-off, make
    the mission with `aicvds mission create --note`."""
    uplink: Annotated[Uplink, arg(metavar="full|delta|pruned")] = "full"
    """The part of each report to send: full, the sensors that changed (delta, with the same decisions), or the k
    sensors that attention on board selects (pruned)."""
    deadline_ms: Annotated[int | None, arg(metavar="MS", help_behavior_hint="")] = None
    """Milliseconds that the edge may take for one decision, 10 to 60000. Default: the edge's own setting."""
    wait_s: Annotated[float, arg(metavar="S")] = 120.0
    """Seconds to wait for the edge and its LLM. An edge that still loads its LLM then decides without it."""
    await_llm: Annotated[Literal["on", "off"], arg(metavar="on|off")] = "off"
    """on: wait for an unreachable LLM as for a loading one."""
    reconnect_s: Annotated[float, arg(metavar="S")] = 10.0
    """Seconds to wait during the flight for a lost edge and its LLM, in all per outage, 0 to 3600; 0 never waits."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder to write to, made if missing. Default: runs/ and the mission's ID, such as runs/paper-0-1f6c09ab."""
    bound: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = True
    """Leave out the search, of at most 10 s after the flight, for the fewest packets that any fleet could have lost."""
    overwrite: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = False
    """Overwrite an earlier mission's result."""
    metrics_port: Annotated[int, arg(metavar="0-65535")] = 0
    """Port of the flight's metrics for Prometheus, served during the flight and until one more scrape (at most 20 s);
    0: none."""
    metrics_host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address for that port; 0.0.0.0 for every interface. The metrics need no key."""


def main(argv: list[str]) -> int:
    """Run ``aicvds simulate``; returns the exit code."""
    command = shlex.join(["aicvds", "simulate", *argv])
    return command_main(Simulate, "aicvds simulate", argv, lambda options, console: simulate(options, command, console))


def simulate(options: Simulate, command: str, console: Console) -> int:
    """Fly, write, print; returns the exit code.

    Raises:
        UsageError: the options are unusable, or the folder cannot be written.
        EdgeError: no edge is ready.
    """
    site = site_from_options(options.scenario, options.world, options.steps)
    check(options)
    from simulator.flying.flight_metrics import FlightMetrics, serve_metrics

    mission_id = options.mission or new_mission_id(site.scenario, options.seed)
    job = Job(
        site=site,
        seed=options.seed,
        mission_id=mission_id,
        out=options.out or Path("runs") / mission_id,
        command=command,
        policy=options.policy,
        edge=options.edge if options.policy == "edge" else None,
        mode=options.mode,
        note=options.note,
        named=options.mission is not None,
        uplink=options.uplink,
        deadline_ms=options.deadline_ms,
        wait_s=options.wait_s,
        wait_out=("loading", "unavailable") if options.await_llm == "on" else ("loading",),
        reconnect_s=options.reconnect_s,
        bound_s=BOUND_S if options.bound else 0.0,
    )
    refuse_old_result(job.out, options.overwrite)
    metrics = FlightMetrics(site.scenario.steps)
    with serve_metrics(metrics, options.metrics_host, options.metrics_port) as scrapes:
        code = run_mission(job, console, metrics=metrics)
        # All results are written: Ctrl-C only ends this wait.
        if scrapes is not None and code != INTERRUPTED:
            with console.status("Waiting until Prometheus has the last numbers"), suppress(KeyboardInterrupt):
                scrapes.await_last()
    return code


def check(options: Simulate) -> None:
    """Raises ``UsageError`` for the first option out of bounds."""
    from simulator.policies.registry import POLICY_NAMES

    check_seed(options.seed)
    check_wait(options.wait_s)
    if options.policy not in ("edge", *POLICY_NAMES) and ":" not in options.policy:
        known = ", ".join(POLICY_NAMES)
        raise UsageError(f"--policy {options.policy}: choose one of edge, {known}, or MODULE:CLASS")
    check_deadline(options.deadline_ms)
    check_between("--reconnect-s", options.reconnect_s, 0, 3600)
    check_between("--metrics-port", options.metrics_port, 0, 65_535)
    if options.policy == "edge":
        edge_from_option(options.edge)
        check_mission(options.mission)
        check_note(options.note)
        return
    if options.edge is not None:
        raise UsageError(f"--policy {options.policy} asks no edge, so --edge contradicts it; give one of the two")
    of_an_edge: dict[str, object] = {"mode": options.mode, "mission": options.mission, "note": options.note}
    of_an_edge |= {"uplink": None if options.uplink == "full" else options.uplink, "deadline-ms": options.deadline_ms}
    for name, value in of_an_edge.items():
        if value is not None:
            raise UsageError(f"--policy {options.policy} asks no edge, so --{name} {value} means nothing; leave it out")
