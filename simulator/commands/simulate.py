"""``aicvds simulate``: fly one mission against an edge and leave its summary, decisions and report."""

import re
import shlex
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, UseAppendAction, arg

from shared.wire.schemas import LLM_MODES, Mode, Uplink
from simulator.commands.options import (
    WorldOptions,
    check_between,
    check_deadline,
    check_mission,
    check_note,
    check_wait,
    edge_from_option,
    site_of,
)
from simulator.commands.running import command_main
from simulator.errors import INTERRUPTED, UsageError
from simulator.flying.job import BASELINES, BOUND_S, EDGE_MODE, Job, new_mission_id
from simulator.flying.local_edge import edge_in_folder
from simulator.flying.run import run_mission
from simulator.records.run_folder import DECISIONS, fresh_folder, refuse_old_result

# The options that a job has under the same name.
_PASSED_ON = ("seed", "note", "uplink", "deadline_ms", "wait_s", "reconnect_s")


@dataclass(frozen=True)
class Simulate(WorldOptions):
    """Fly one mission against an edge and write its results.

    The UAVs fly the scenario's world step by step, ask the edge for a decision at every waypoint, and report the cost
    of each decision. EOF and WQCS then fly the same world for comparison. Written to --out: summary.json,
    decisions.jsonl (one decision a line, written at once), report.html (open it in a browser), figures, with an edge
    requests.jsonl (the requests, about 1 kB a decision with 10 sensors, for `aicvds replay`).

    Start an edge, then fly against it from another terminal:

      aicvds serve

      aicvds simulate --edge http://127.0.0.1:8000 --out runs/first

    Without an edge:

      aicvds simulate --policy eof

    Your own pipeline:

      aicvds simulate --policy eof --world examples/pipeline_world

    Your own policy beside the edge's modes and a planner, in a larger world:

      aicvds simulate --policy fullest.py:FullestInRange --against edge:value --against mpc --sensors 20 --uavs 5

    If the edge is lost during the flight, the UAVs collect from the longest queue in reach at their last velocities,
    and before the next step wait up to --reconnect-s seconds for the edge to come back. Steps are not real time, so
    without this pause the mission would end first.

    Ctrl-C stops the flight and still writes the report of the steps flown. The environment variable AICVDS_API_KEY has
    the key for an edge that needs one. Exit code: 0 flown, 1 no edge, 2 bad use, 130 interrupted.
    """

    edge: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """The edge's address, such as http://127.0.0.1:8000. Required, unless --policy is a local one."""
    policy: Annotated[str, arg(metavar="NAME")] = "edge"
    """The decider: edge, or without an edge the paper's eof (earliest overflow first) or wqcs (queue times rate), each
    also as NAME_coordinated (UAVs leave out the sensors taken in the step), longest_queue, queue_and_channel, max_gain
    (highest channel gain), nearest (nearest neighbour), round_robin, random, mpc (a planner, extra `planner`),
    or a class of your own as FILE.py:CLASS or MODULE:CLASS. edge:MODE, such as edge:value, starts an edge for this
    flight, in that mode."""
    against: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Fly this policy in the same world too, for comparison with EOF and WQCS: a name as for --policy, or edge:MODE;
    repeatable. Modes are flown at --edge, or at an edge that is started for it."""
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
    pace: Annotated[str | None, arg(metavar="real|Nx", help_behavior_hint="")] = None
    """The speed of the flight by the world's clock: real, or 10x and so on. Default: as fast as decisions come."""
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
    site = site_of(options)
    check(options)
    from simulator.flying.flight_metrics import FlightMetrics, serve_metrics

    mission_id = options.mission or new_mission_id(site.scenario, options.seed)
    out = options.out or Path("runs") / mission_id
    refuse_old_result(out, options.overwrite)
    refuse_old_result(out, options.overwrite, DECISIONS)
    own_mode = _mode_of(options.policy)
    with ExitStack() as stack:
        edge, alive = options.edge and edge_from_option(options.edge), (lambda: None)
        modes = [mode for mode in map(_mode_of, (options.policy, *options.against)) if mode is not None]
        if modes and edge is None:
            fresh_folder(out)
            with_llm = next((mode for mode in modes if mode in LLM_MODES), modes[0])
            edge, alive = stack.enter_context(edge_in_folder(out, console, with_llm))
        job = Job(
            site=site,
            mission_id=mission_id,
            out=out,
            command=command,
            policy=options.policy if own_mode is None else "edge",
            edge=edge,
            mode=own_mode or options.mode,
            named=options.mission is not None,
            wait_out=("loading", "unavailable") if options.await_llm == "on" else ("loading",),
            bound_s=BOUND_S if options.bound else 0.0,
            against=tuple(dict.fromkeys((*BASELINES, *options.against))),
            pace=_pace(options.pace),
            **{name: getattr(options, name) for name in _PASSED_ON},
        )
        metrics = FlightMetrics(site.scenario.steps)
        with serve_metrics(metrics, options.metrics_host, options.metrics_port) as scrapes:
            code = run_mission(job, console, alive, metrics)
            # All results are written: Ctrl-C only ends this wait.
            if scrapes is not None and code != INTERRUPTED:
                with console.status("Waiting until Prometheus has the last numbers"), suppress(KeyboardInterrupt):
                    scrapes.await_last()
    return code


def check(options: Simulate) -> None:
    """Raises ``UsageError`` for the first option out of bounds."""
    from simulator.policies.registry import policy_named

    check_wait(options.wait_s)
    if "edge" in options.against:
        raise UsageError("--against edge: say in which mode, such as --against edge:value")
    for option, name in (("--policy", options.policy), *(("--against", other) for other in options.against)):
        _check_policy(option, name)
        if name != "edge" and _mode_of(name) is None:
            policy_named(name)
    check_deadline(options.deadline_ms)
    _pace(options.pace)
    check_between("--reconnect-s", options.reconnect_s, 0, 3600)
    check_between("--metrics-port", options.metrics_port, 0, 65_535)
    check_mission(options.mission)
    check_note(options.note)
    if options.policy == "edge" or options.edge is not None:
        edge_from_option(options.edge)
    if options.policy == "edge":
        return
    if (mode := _mode_of(options.policy)) is not None:
        if options.mode not in (None, mode):
            raise UsageError(f"--policy {options.policy} and --mode {options.mode} contradict each other")
    else:
        _check_no_edge(options)


def _check_policy(option: str, name: str) -> None:
    from simulator.policies.registry import POLICY_NAMES

    if name.startswith(EDGE_MODE):
        if _mode_of(name) is None:
            raise UsageError(f"{option} {name}: choose one of {', '.join(EDGE_MODE + mode for mode in get_args(Mode))}")
    elif name not in ("edge", *POLICY_NAMES) and ":" not in name:
        known = ", ".join(POLICY_NAMES)
        raise UsageError(f"{option} {name}: choose one of edge, {known}, edge:MODE, FILE.py:CLASS or MODULE:CLASS")


def _check_no_edge(options: Simulate) -> None:
    """Raises ``UsageError`` for an option that concerns an edge alone, where none is asked."""
    if options.edge is not None and not any(map(_mode_of, options.against)):
        raise UsageError(f"--policy {options.policy} asks no edge, so --edge contradicts it; give one of the two")
    of_an_edge: dict[str, object] = {"mode": options.mode, "mission": options.mission, "note": options.note}
    of_an_edge |= {"uplink": None if options.uplink == "full" else options.uplink, "deadline-ms": options.deadline_ms}
    for name, value in of_an_edge.items():
        if value is not None:
            raise UsageError(f"--policy {options.policy} asks no edge, so --{name} {value} means nothing; leave it out")


def _mode_of(policy: str) -> Mode | None:
    """MODE of a policy ``edge:MODE``; ``None`` for another."""
    return next((mode for mode in get_args(Mode) if policy == EDGE_MODE + mode), None)


def _pace(given: str | None) -> float | None:
    """How many times faster than the world's clock the flight is; ``None`` for as fast as it can."""
    if given is None or given == "real":
        return None if given is None else 1.0
    number = re.fullmatch(r"(\d{1,4}(?:\.\d{1,3})?)x", given)
    if number is None or not float(number[1]):
        raise UsageError(f"--pace {given[:32]}: write real, or how many times faster, such as 10x")
    return float(number[1])
