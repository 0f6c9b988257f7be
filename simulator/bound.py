"""``aicvds bound``: the least that any fleet could have lost in one world, all arrivals known."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from tyro.conf import arg

from simulator.commandline import check_between, check_seed, command_main
from simulator.record import Record, naming_out
from simulator.site import Site, chosen_site

# The world and OR-Tools take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from shared.fleetplan import FleetProblem, News, Plan


@dataclass(frozen=True)
class BoundOptions:
    """Find the least packets that any fleet could have lost in one world.

    A planner that knows every arrival beforehand (no UAV does) looks for the best flight with OR-Tools CP-SAT
    and proves how much better another could at most be. No scheme loses less than the proven bound; what a scheme
    loses above it is what better decisions could still save.

    Printed: the proven bound, the best plan found, the gap between them, and what EOF loses in the same world. The
    plan is flown in the simulated world, which must lose exactly what the plan says.

      aicvds bound --seed 0

      aicvds bound --seed 0 --scenario stress --time-limit-s 120 --out bound.json

    `paper` is solved in about a second. `stress` and `dense` are not solved in 60 s: seed 0 of `stress` was proven to
    lose at least 599 packets, with a flight that loses 827 (EOF 1009); of `dense`, at least 0, with 438 (EOF 1171).
    Of worlds as large as `dense`, writing the problem down takes up to half a minute more than --time-limit-s. Ctrl-C
    ends the search, and the best so far is printed. Exit code: 0 done, also by Ctrl-C; 2 bad use.
    """

    seed: Annotated[int, arg(metavar="N")]
    """Of the world, 0 to 4294967295."""
    scenario: Annotated[str | None, arg(metavar="NAME")] = None
    """A ready-made world: paper (the default), pipeline, stress, dense or lossy_uplink."""
    world: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """A world of your own, instead of --scenario; `aicvds simulate --help` says what is in the folder."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Waypoints to fly, 1 to 10000. Default: the scenario's (30)."""
    time_limit_s: Annotated[float, arg(metavar="S")] = 60.0
    """Seconds to search, 0.1 to 86400; less is used where the proof is done sooner."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """JSON file to write the bound and the plan to."""


@dataclass(frozen=True, eq=False)
class Bound:
    """What is the least that can be lost in one world.

    Attributes:
        lower_bound: proven: no flight loses fewer packets.
        lost_packets: what the best flight found loses.
        actions: that flight, shape ``(T, I, 2)``: sensor, velocity.
        seconds: of searching.
    """

    lower_bound: int
    lost_packets: int
    actions: NDArray[np.int64]
    seconds: float

    @property
    def optimal(self) -> bool:
        """Whether the flight is proven to be the best."""
        return self.lost_packets == self.lower_bound

    @property
    def gap(self) -> int:
        """Packets between the flight and the bound."""
        return self.lost_packets - self.lower_bound


class BoundRecord(Record):
    """The JSON file: a :class:`Bound`, the world it is of, and what EOF loses there."""

    scenario: str
    seed: int
    steps: int
    lower_bound: int
    lost_packets: int
    optimal: bool
    gap: int
    eof_lost_packets: int
    seconds: float
    actions: list[list[tuple[int, int]]]


def main(argv: list[str]) -> int:
    """Bound the world that the command line describes; returns the exit code."""
    return command_main(BoundOptions, "aicvds bound", argv, _run)


def clairvoyant(
    site: Site, seed: int, time_limit_s: float = 60.0, workers: int = 8, on_news: Callable[[News], None] | None = None
) -> Bound:
    """Bound one world, knowing all its arrivals.

    Batteries are left out of the bound where a link's strength decides what a packet costs, which can only lower it;
    the flight found is flown with batteries as they are.

    Args:
        site: the scenario, and its trace if it has one.
        seed: of the world.
        time_limit_s: seconds to search; the bound and the flight hold whenever it ends, but depend on the machine.
        workers: threads of the solver, for worlds that one does not solve quickly.
        on_news: called with each better plan or bound, from a thread of the solver.

    Raises:
        RuntimeError: the world did not lose what the plan says, so that one of the two is wrong.
        ModuleNotFoundError: OR-Tools is not installed (extra ``planner``).
        Interrupted: by Ctrl-C; it carries the best plan so far.
    """
    from shared.fleetplan import least_loss

    return confirmed(site, seed, least_loss(problem_of(site, seed), time_limit_s, workers, on_news))


def confirmed(site: Site, seed: int, plan: Plan) -> Bound:
    """The bound that a plan of the whole mission proves, after flying it in the world.

    Raises:
        RuntimeError: the world did not lose what the plan says.
    """
    flown = replay(site, seed, plan.actions)
    if flown != plan.lost_packets:
        raise RuntimeError(f"the plan of seed {seed} loses {plan.lost_packets} packets, flown in the world {flown}")
    # Lost packets are whole; the margin is for the solver's own rounding.
    proven = int(np.ceil(plan.lower_bound - 1e-6))
    return Bound(proven, plan.lost_packets, plan.actions, plan.seconds)


def problem_of(site: Site, seed: int) -> FleetProblem:
    """The whole mission as a planning problem, with what only the world knows."""
    from shared.fleetplan import FleetProblem

    world = site.world()
    world.reset(seed=seed)
    return FleetProblem(
        scenario=site.scenario,
        trajectories=world.fleet.trajectories,
        progress_m=world.fleet.progress_m,
        places=world.sensors.positions,
        queue=world.sensors.initial_queue,
        battery=world.sensors.battery,
        arrivals=world.sensors.arrivals,
    )


def replay(site: Site, seed: int, actions: NDArray[np.int64]) -> int:
    """Fly actions ``(T, I, 2)`` in the world; returns the packets lost."""
    world = site.world()
    world.reset(seed=seed)
    for step in actions:
        world.step(dict(zip(world.possible_agents, step, strict=True)))
    return sum(tally.lost_packets for tally in world.tally)


def _run(options: BoundOptions, console: Console) -> int:
    site = chosen_site(options.scenario, options.world, options.steps)
    scenario = site.scenario
    check_seed(options.seed)
    check_between("--time-limit-s", options.time_limit_s, 0.1, 86_400)
    if options.out is not None:
        with naming_out(options.out):
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.touch()
    from shared.fleetplan import Interrupted
    from simulator.policies import policy_named
    from simulator.rollout import rollout

    with console.status("Searching for the best flight") as status:

        def told(news: News) -> None:
            status.update(f"Searching: best so far {news.objective:.0f} lost, proven at least {news.lower_bound:.0f}")

        try:
            bound = clairvoyant(site, options.seed, options.time_limit_s, on_news=told)
        except Interrupted as stopped:
            bound = confirmed(site, options.seed, stopped.plan)
    eof = sum(tally.lost_packets for tally in rollout(site.world(), policy_named("eof"), options.seed))
    record = BoundRecord(
        scenario=scenario.name,
        seed=options.seed,
        steps=scenario.steps,
        lower_bound=bound.lower_bound,
        lost_packets=bound.lost_packets,
        optimal=bound.optimal,
        gap=bound.gap,
        eof_lost_packets=eof,
        seconds=round(bound.seconds, 3),
        actions=bound.actions.tolist(),
    )
    _show(record, console)
    if options.out is not None:
        with naming_out(options.out):
            options.out.write_text(record.model_dump_json() + "\n", encoding="utf-8")
        console.print(f"Wrote {options.out}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _show(record: BoundRecord, console: Console) -> None:
    from rich.table import Table

    table = Table("packets lost", "", title=f"{record.scenario}, seed {record.seed}, {record.steps} steps")
    table.add_row("no flight loses fewer than", str(record.lower_bound))
    table.add_row("the best flight found", str(record.lost_packets))
    table.add_row("gap", "0: proven optimal" if record.optimal else str(record.gap))
    table.add_row("EOF", str(record.eof_lost_packets))
    console.print(table)
    console.print(f"Searched {record.seconds:.1f} s. The flight was flown in the world and lost just that.")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
