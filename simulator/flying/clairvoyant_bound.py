"""The clairvoyant bound: the least that any fleet could have lost in one world, all arrivals known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from simulator.sites.site import Site

# The world and OR-Tools take seconds to import; `--help` and bad use answer without them.
if TYPE_CHECKING:
    from shared.fleetplan import FleetProblem, News, Plan


@dataclass(frozen=True, eq=False)
class Bound:
    """A bound on the packets lost in one world, and the best flight found.

    Attributes:
        lower_bound: proven; no flight loses fewer packets.
        lost_packets: of the best flight found.
        actions: of that flight, shape ``(T, I, 2)``: sensor, velocity.
        seconds: of the search.
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
        """Packets that the flight loses above the bound."""
        return self.lost_packets - self.lower_bound


def clairvoyant(
    site: Site, seed: int, time_limit_s: float = 60.0, workers: int = 8, on_news: Callable[[News], None] | None = None
) -> Bound:
    """Bound one world with all its arrivals known.

    The bound omits batteries where a link's strength decides the energy of a packet, which can only lower it. The
    flight found is flown with the true batteries.

    Args:
        site: the scenario, and its trace if it has one.
        seed: of the world.
        time_limit_s: of the search; the bound and the flight are valid whenever it ends, but depend on the machine.
        workers: threads of the solver, for worlds that one thread does not solve quickly.
        on_news: called with each better plan or bound, from a thread of the solver.

    Raises:
        RuntimeError: the world lost another number of packets than the plan, so one of the two is wrong.
        ModuleNotFoundError: OR-Tools is not installed (extra ``planner``).
        Interrupted: by Ctrl-C, with the best plan so far.
    """
    from shared.fleetplan import least_loss

    return confirmed(site, seed, least_loss(problem_of(site, seed), time_limit_s, workers, on_news))


def confirmed(site: Site, seed: int, plan: Plan) -> Bound:
    """The bound that a plan of the whole mission proves, confirmed by a flight of the plan in the world.

    Raises:
        RuntimeError: the world lost another number of packets than the plan.
    """
    flown = replay(site, seed, plan.actions)
    if flown != plan.lost_packets:
        raise RuntimeError(f"the plan of seed {seed} loses {plan.lost_packets} packets, flown in the world {flown}")
    # Lost packets are whole numbers; the margin covers the solver's rounding.
    proven = int(np.ceil(plan.lower_bound - 1e-6))
    return Bound(proven, plan.lost_packets, plan.actions, plan.seconds)


def problem_of(site: Site, seed: int) -> FleetProblem:
    """The whole mission as a planning problem, with the world's hidden state."""
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
