"""The exact time-expanded formulation of a fleet's plan, for OR-Tools CP-SAT.

The integer ``c_it`` is the sum of UAV i's velocities up to step t. After step t the UAV has flown ``c_it x step_s``
metres along its trajectory, for any shape of the trajectory. The Boolean ``x_ijtk`` says that it collects from sensor j
in step t over a link of at least ``p_k`` packets; it confines ``c_it`` to the values from which that link holds. For
sensor j, ``q_jt`` is the queue before step t and ``l_jt`` its lost packets in that step:

    q_j(t+1) + l_jt >= q_jt + a_jt - sum_ik p_k x_ijtk,   q_j(t+1) + l_jt >= a_jt,   q_jt <= W

with at most one x for each UAV and step, and at most one for each sensor and step. Smaller queues are never worse, so
that minimising the sum of ``l`` makes these inequalities the rule of :mod:`shared.world.step_rule`, with which a
property test compares them. Redundant constraints make the search quick, one for every sensor and every run of steps
s..e in which more than W packets come together:

    sum_t l_jt + excess x sum_t x_jt >= excess,   excess = the queue at its start and the arrivals since, less W

That is, without a visit in these steps the sensor loses the excess.

Batteries enter only as the packets that each can pay for over its best link, all steps together. This ignores the
higher cost of a weak link, and so keeps every plan that the world allows: the proven bound stays valid.
"""

from collections import defaultdict
from collections.abc import Iterable
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from ortools.sat.python import cp_model

from shared.planning.fleet_problem import Course, FleetProblem, fly
from shared.world.channel import IntArray, rate_bps
from shared.world.step_rule import joules_a_packet

# The Booleans that serve a sensor in a step, and the packets that each moves.
Visits = list[tuple[Any, int]]
Links = Literal["exact", "cautious", "hopeful"]


class Serve(NamedTuple):
    """A UAV collects from a sensor in a step: over a link of at least ``needed`` packets, and so moves ``packets``."""

    uav: int
    sensor: int
    step: int
    packets: int
    needed: int


class Level(NamedTuple):
    """A level of a sensor's links; as the fields of :class:`Serve`, with the sums of velocities ``within`` it."""

    packets: int
    needed: int
    within: NDArray[np.bool_]


class Formulation:
    """The model of one problem.

    ``links`` says how exactly the model takes the capacity of links. ``exact``: level by level, as in the world, which
    needs several times the Booleans. ``cautious``: every link moves no more than the weakest link that holds, so that
    the plans lose at most their objective. ``hopeful``: every link moves as much as the strongest, so that the bound
    holds in the world. Often all three agree, and then the last two have proven an exact plan quickly.

    Attributes:
        model: for the solver.
        flown: ``c_it`` by UAV and step.
        serves: ``x`` by its meaning.
    """

    def __init__(self, problem: FleetProblem, links: Links = "exact") -> None:
        self.problem = problem
        self._links = links
        self.model = cp_model.CpModel()
        self.flown: list[list[Any]] = []
        self.serves: dict[Serve, Any] = {}
        self._queue: list[list[Any]] = []
        self._lost: list[list[Any]] = []
        for uav in range(problem.uavs):
            self._fly(uav)
        self._exclude()
        visits = self._visits()
        for sensor, affordable in enumerate(_affordable(problem).tolist()):
            self._store(sensor, affordable, visits[sensor])
        self.model.minimize(_total(over for lost in self._lost for over in lost))

    @cached_property
    def _most(self) -> IntArray:
        """The largest possible queue of each sensor before each step, shape ``(H, J)``: no transfer moves more."""
        problem, capacity = self.problem, self.problem.scenario.queue_capacity
        most = [problem.queue]
        for arrivals in problem.arrivals[:-1]:
            most.append(np.minimum(most[-1] + arrivals, capacity))
        return np.array(most)

    @cached_property
    def _overflow(self) -> IntArray:
        """The largest possible loss of each sensor in each step, and 0 after the last, shape ``(H + 1, J)``."""
        most = np.maximum(self._most + self.problem.arrivals - self.problem.scenario.queue_capacity, 0)
        return np.concatenate((most, np.zeros_like(most[:1])))

    def _fly(self, uav: int) -> None:
        """Add one UAV's variables: velocities within 0..max, and the sensors that it can serve."""
        problem, model = self.problem, self.model
        fastest = problem.scenario.max_velocity
        row: list[Any] = []
        summed = np.arange(problem.horizon * fastest + 1)
        same = problem.links is None or len(problem.links[uav]) == 1
        first = problem.packets(uav, summed, 0)
        links = [first if same else problem.packets(uav, summed, step) for step in range(problem.horizon)]
        for step in range(problem.horizon):
            reached = links[step][: (step + 1) * fastest + 1]
            now = model.new_int_var(0, len(reached) - 1, f"c_{uav}_{step}")
            model.add_linear_constraint(now - (row[-1] if row else 0), 0, fastest)
            row.append(now)
            self._serve_within(uav, step, now, np.minimum(reached, self._most[step]))
        self.flown.append(row)

    def _serve_within(self, uav: int, step: int, now: Any, packets: IntArray) -> None:
        """Add a Boolean for every sensor that the UAV can serve in this step and for every level of its links."""
        for sensor in np.flatnonzero(packets.any(axis=0)).tolist():
            for level in _levels(packets[:, sensor], self._links):
                serve = Serve(uav, sensor, step, level.packets, level.needed)
                literal = self.model.new_bool_var(f"x_{uav}_{sensor}_{step}_{level.needed}")
                within = cp_model.Domain.from_values(np.flatnonzero(level.within).tolist())
                self.model.add_linear_expression_in_domain(now, within).only_enforce_if(literal)
                self.serves[serve] = literal

    def _exclude(self) -> None:
        """Let a UAV serve at most one sensor in a step, and a sensor at most one UAV."""
        rivals: dict[tuple[str, int, int], list[Any]] = defaultdict(list)
        for serve, literal in self.serves.items():
            rivals["uav", serve.uav, serve.step].append(literal)
            rivals["sensor", serve.sensor, serve.step].append(literal)
        for literals in rivals.values():
            if len(literals) > 1:
                self.model.add_at_most_one(literals)

    def _visits(self) -> list[list[Visits]]:
        """The visits of each sensor in each step, ``[j][t]``."""
        problem = self.problem
        visits: list[list[Visits]] = [[[] for _ in range(problem.horizon)] for _ in range(problem.sensors)]
        for serve, literal in self.serves.items():
            visits[serve.sensor][serve.step].append((literal, serve.packets))
        return visits

    def _store(self, sensor: int, affordable: int, visits: list[Visits]) -> None:
        """Add one sensor's queue and its losses."""
        problem, model, capacity = self.problem, self.model, self.problem.scenario.queue_capacity
        supply = [int(problem.queue[sensor]), *problem.arrivals[:, sensor].tolist()]
        queue: list[Any] = [supply[0]]
        lost: list[Any] = []
        for step, arrived in enumerate(supply[1:]):
            filled = int(self._most[step, sensor]) + arrived
            after = model.new_int_var(min(arrived, capacity), min(filled, capacity), "")
            over = model.new_int_var(max(0, arrived - capacity), int(self._overflow[step, sensor]), "")
            drained = _total(packets * literal for literal, packets in visits[step])
            model.add(after + over >= queue[-1] + arrived - drained)
            if arrived > capacity:
                model.add(after + over >= arrived)
            queue.append(after)
            lost.append(over)
        if sum(supply) > affordable:
            # Every packet is lost, still in the queue, or paid for by the battery.
            model.add(_total(lost) + queue[-1] >= sum(supply) - affordable)
        self._must_visit(supply, lost, visits, capacity)
        self._queue.append(queue[1:])
        self._lost.append(lost)

    def _must_visit(self, supply: list[int], costs: list[Any], visits: list[Visits], room: int) -> None:
        """Let every run of steps without a visit cost the packets that have no room.

        ``costs[t]`` is the cost of step t, and ``supply[0]`` the queue before step 0.
        """
        for start in range(len(supply)):
            excess = supply[start] - room
            for end in range(start + 1, len(supply)):
                excess += supply[end]
                if excess > room:
                    break
                if excess > 0:
                    within = _total(literal for step in visits[start:end] for literal, _ in step)
                    self.model.add(_total(costs[max(start - 1, 0) : end]) + excess * within >= excess)

    def hint(self, actions: IntArray) -> None:
        """Let the search start from these actions ``(H, I, 2)``."""
        course = fly(self.problem, actions)
        flown = np.cumsum(actions[:, :, 1], axis=0)
        for uav, row in enumerate(self.flown):
            for step, variable in enumerate(row):
                self.model.add_hint(variable, int(flown[step, uav]))
        served = self._served(actions, course)
        for serve, literal in self.serves.items():
            self.model.add_hint(literal, int(serve in served))
        for sensor, row in enumerate(self._queue):
            for step, variable in enumerate(row):
                self.model.add_hint(variable, int(course.queue[step + 1, sensor]))
                self.model.add_hint(self._lost[sensor][step], int(course.lost[step, sensor]))

    def _served(self, actions: IntArray, course: Course) -> set[Serve]:
        """The best level of every transfer of these actions."""
        best: dict[tuple[int, int], Serve] = {}
        for serve in self.serves:
            made = (serve.step, serve.uav)
            if actions[made][0] == serve.sensor and course.link[made] >= serve.needed:
                best[made] = max(serve, best.get(made, serve))
        return set(best.values())

    def actions(self, value: Any) -> IntArray:
        """The actions ``(H, I, 2)`` of a solution, ``value`` giving the value of a variable."""
        problem = self.problem
        flown = np.array([[value(c) for c in row] for row in self.flown], dtype=np.int64)
        velocity = np.diff(flown, axis=1, prepend=0)
        sensor = np.full((problem.horizon, problem.uavs), -1)
        for serve, literal in self.serves.items():
            if value(literal):
                sensor[serve.step, serve.uav] = serve.sensor
        for step, row in enumerate(sensor):
            for uav in np.flatnonzero(row < 0).tolist():
                row[uav] = self._spare(row, uav, int(flown[uav, step]), problem.queue)
        return np.stack([sensor, velocity.T], axis=-1)

    def _spare(self, chosen: IntArray, uav: int, flown: int, queue: IntArray) -> int:
        """A sensor for a UAV that needs none, so that it blocks no other UAV's transfer."""
        free = ~np.isin(np.arange(self.problem.sensors), chosen)
        distance = self.problem.distance(uav, np.array(flown))
        if free.any():
            return int(np.argmin(np.where(free, distance, np.inf)))
        # With fewer sensors than UAVs: a sensor that an earlier UAV serves, otherwise the farthest.
        earlier = chosen[:uav]
        return int(earlier[0]) if len(earlier) else int(np.argmax(distance))


def _levels(packets: IntArray, links: Links) -> list[Level]:
    """The levels of certain links: the packets that a transfer moves, and those that its link must be able to."""
    levels = np.unique(packets[packets > 0]).tolist()
    match links:
        case "exact":
            pairs = [(level, level) for level in levels]
        case "cautious":
            pairs = [(levels[0], levels[0])]
        case "hopeful":
            pairs = [(levels[-1], levels[0])]
    return [Level(moved, needed, packets >= needed) for moved, needed in pairs]


def _affordable(problem: FleetProblem) -> IntArray:
    """Packets that each battery pays for over the best link, the one from right above, shape ``(J,)``."""
    world = problem.scenario
    joules = joules_a_packet(rate_bps(0.0, world), world)
    return np.asarray(np.floor(np.minimum(problem.battery / joules, 1e9) + 1e-6), dtype=np.int64)


def _total(terms: Iterable[Any]) -> Any:
    return cp_model.LinearExpr.sum(list(terms))
