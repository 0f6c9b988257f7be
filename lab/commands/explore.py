"""``python -m lab explore``: fly training worlds, and record every decision and a teacher's."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console
from rich.progress import track
from tyro.conf import arg

from lab.executors import ordered_map
from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, RolloutStep, write_rollouts
from lab.scenario_changes import ScenarioChanges
from shared.client.errors import EdgeError
from shared.world.scenario import Scenario
from simulator.commands.options import scenario_from_options
from simulator.errors import UsageError
from simulator.policies.registry import policy_named

# The world and the planner take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from lab.exploration.teachers import TeacherName

TeacherOption = Literal["both", "planner", "clairvoyant"]
_BEHAVIOUR = "taught: mostly the reference's; untaught: half a heuristic's, half a random sensor; a random velocity"

# Seconds in which an edge loads its LLM.
READY_S = 30.0


@dataclass(frozen=True, kw_only=True)
class Explore(ScenarioChanges):
    """Fly training worlds with exploring UAVs, and record each decision, its cost, and a teacher's reference action.

    The worlds' seeds start at 1,000,000, apart from every evaluation seed. The file feeds `python -m lab pretrain`.

      python -m lab explore --workers 2 --out runs/rollouts.jsonl.gz

    The teacher alternates by world between the planner (partial observations, about 4 s a world) and a clairvoyant (all
    arrivals known, 1 to 3 s). A UAV mostly flies the teacher's actions. In up to half (planner) or a fifth
    (clairvoyant) of a world's steps the fleet deviates, so that the records cover other states: then half of the
    sensors are a heuristic's, half random, and velocities are random; a third of the deviations use the teacher's
    sensor, a third its velocity. The reference is the teacher's action in the state recorded. A clairvoyant has none
    while the fleet deviates, and plans again afterwards.

    Further worlds have no teacher, and every step deviates. The same command writes the same decisions, whatever the
    number of workers. `--first` adds further worlds in a file of their own; `python -m lab pretrain` takes several
    files, of several scenarios.

    With `--edge` the UAVs fly that edge's decisions, and the records also have the teacher's action in each state.
    So an LLM learns from the states that its own decisions lead to (DAgger, Ross et al. 2011). With `--policy` they
    fly that policy's: `lab.experiments.formula_planner:FormulaPlanner` believes in the formulas' links and so brings
    about failures that a teacher avoids.
    """

    out: Annotated[Path, arg(metavar="FILE")]
    """File to write, such as runs/rollouts.jsonl.gz."""
    missions: Annotated[int, arg(metavar="N")] = 400
    """Worlds with a teacher. They need the extra `planner`."""
    untaught: Annotated[int, arg(metavar="N")] = 300
    """Further worlds without a teacher."""
    teacher: TeacherOption = "both"
    """The teacher: the planner, a clairvoyant, or both in alternation."""
    scenario: Annotated[str, arg(metavar="NAME")] = "paper"
    """The worlds' scenario."""
    first: Annotated[int, arg(metavar="N")] = 0
    """Number of the first world: its seed is 1,000,000 more."""
    edge: Annotated[str | None, arg(metavar="URL")] = None
    """An edge whose decisions are flown, in the edge's own mode without planner and verifier, such as
    http://127.0.0.1:8000."""
    policy: Annotated[str | None, arg(metavar="NAME")] = None
    """A policy whose decisions are flown, such as mpc, or MODULE:CLASS."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Processes that fly the worlds, 1 to 64."""
    ray: Annotated[str | None, arg(metavar="local|HOST:PORT", help_behavior_hint="")] = None
    """Fly the worlds as tasks of Ray: of one that starts here with --workers processes, or of a cluster with this
    machine in it. Needs the extra `ray`."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab explore``; returns the exit code."""
    args = tyro.cli(Explore, prog="python -m lab explore", args=argv)
    try:
        scenario = scenario_from_options(args.scenario, changes=args.changes)
        if args.edge is not None and args.policy is not None:
            raise ValueError("--edge and --policy exclude each other: name whose decisions are flown")
        for name in ("missions", "untaught", "first"):
            if getattr(args, name) < 0:
                raise ValueError(f"--{name} {getattr(args, name)} is less than 0")
        if args.missions + args.untaught < 1:
            raise ValueError("--missions and --untaught are 0: there is nothing to fly")
        if not 1 <= args.workers <= 64:
            raise ValueError(f"--workers {args.workers} is not between 1 and 64")
        args.out.parent.mkdir(parents=True, exist_ok=True)
        if args.edge is not None:
            _await_edge(args.edge)
        if args.policy is not None:
            policy_named(args.policy)
        behaviour = args.policy or (_BEHAVIOUR if args.edge is None else "an edge's decisions")
        header = Header(scenario=scenario, missions=args.missions + args.untaught, behaviour=behaviour)
        write_rollouts(args.out, header, _explored(scenario, args))
    except (ValueError, OSError, EdgeError, UsageError) as error:
        print(f"python -m lab explore: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as missing:
        fix = "pip install -e '.[lab]', or take --missions 0"
        print(f"python -m lab explore: {missing.name} is not installed: {fix}", file=sys.stderr)
        return 2
    print(f"Wrote {args.out}")
    return 0


def _await_edge(url: str) -> None:
    """Wait until the edge and its LLM are loaded; raises :class:`EdgeError`."""
    from shared.client.edge_client import EdgeClient

    with EdgeClient(url) as client:
        client.wait_ready(READY_S)


def _explored(scenario: Scenario, args: Explore) -> Iterator[RolloutStep]:
    taught = range(args.first, args.first + args.missions)
    teachers = [teacher_of(args.teacher, mission) for mission in taught] + [None] * args.untaught
    worlds = list(enumerate(teachers, start=args.first))
    fly = partial(_mission, scenario, args.edge, args.policy)
    tracked = partial(track, description="Exploring", total=len(worlds), console=Console(stderr=True))
    with ordered_map(args.workers, args.ray) as each:
        for steps in tracked(each(fly, worlds)):
            yield from steps


def _mission(
    scenario: Scenario, edge: str | None, policy: str | None, numbered: tuple[int, TeacherName | None]
) -> list[RolloutStep]:
    mission, teacher = numbered
    return list(explore(scenario, mission, teacher, edge, policy))


def teacher_of(option: TeacherOption, mission: int) -> TeacherName:
    """The teacher of that training world; with ``both``, the planner in even ones."""
    if option == "both":
        return "clairvoyant" if mission % 2 else "planner"
    return option
