"""Receding-horizon planning over a fleet's belief: plan some steps for all UAVs, fly the first, and plan again."""

import math
import time
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.belief.arrivals import Arrivals
from shared.belief.fleet_belief import FAR_M, FleetBelief
from shared.kit.cores import usable_cores
from shared.planning.fleet_problem import FleetProblem, Found, with_fixed
from shared.planning.greedy import look_ahead
from shared.planning.orders import NO_GUIDANCE, Guidance
from shared.planning.queue_chains import Arriving, QueueChains, queue_chains
from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

_HORIZON = 8
# After the horizon a sensor's losses count until the nearest UAV can be there, as if none visited it in the meantime:
# in the first of these numbers of steps that is enough, or else in the last.
_BEYOND = (4, 7, 10, 13)
# A place is good for a sensor if its link's chance is at least this share of the best place's.
_GOOD_SHARE = 0.7
# Between two places of the way after the horizon, as a sum of velocities.
_STRIDE = 4
# The most UAVs whose actions a plan chooses, and how many others it takes into account with their last plans: in both
# cases the nearest ones.
JOINT_UAVS, _NEIGHBOURS = 12, 12
# Up to so many UAVs, and the most sensors of a plan: of these UAVs, of more, and of fleets that a plan does not cover.
# There so many are in reach of those that need a decision. With more sensors the same search finds worse plans.
_FEW_UAVS, _MOST_SENSORS, _OWN_SENSORS = 4, (40, 24, 30), 16
# A plan that is expected to lose fewer packets is not improved: no search could save more.
_NEGLIGIBLE = 0.003


# By run of the search: from the better start (0) or the worse one, and its first temperature as a share of their loss.
RUNS = [(start, heat) for heat in (0.05, 0.15, 0.05) for start in (0, 1)]
# Packets: the least first temperature, and the highest of more than a few UAVs, since a change concerns a small part of
# their loss; the expected loss after the first run from which more runs are worth it, and the better start's from which
# all runs start together.
_LEAST_HEAT, _MOST_HEAT, _WORTH_RUNS, _WORTH_AT_ONCE = 0.02, 1.0, 0.1, 1.0

# The index of a place that does not exist.
_NOWHERE = 10**9


def steps_to(good: NDArray[np.bool_], stride: int, sums: int, fastest: int) -> IntArray:
    """The steps at full speed to the next good place for each sensor, ``(sums, J)``, from velocities' sums 0, 1, ...

    They are more than any way has if no good place follows.

    Args:
        good: shape ``(P, J)``, whether a place is good, at the sums 0, ``stride``, ``2 stride``, ...
        stride: between two places, as a sum of velocities.
        fastest: the velocity.
    """
    count = len(good)
    place = np.where(good, np.arange(count)[:, None], _NOWHERE)
    following = np.minimum.accumulate(place[::-1], axis=0)[::-1]
    summed = np.arange(sums)
    here = np.minimum(-(-summed // stride), count - 1)
    way = following[here] * stride - summed[:, None]
    return np.asarray(-(-np.maximum(way, 0) // fastest))


@dataclass(frozen=True, eq=False)
class Draft:
    """The problem of one plan, taken from a belief.

    Attributes:
        step: the plan's first step.
        uavs: the index of each UAV of the problem, by its column.
        free: the UAVs whose actions the plan may choose.
        kept: shape ``(n,)``, IDs of the sensors in the plan; the problem has one more, which is nowhere.
        problem: to solve.
        before: shape ``(H, I, 2)``, the last plan in the problem's terms.
    """

    step: int
    uavs: list[int]
    free: list[int]
    kept: IntArray
    problem: FleetProblem
    before: IntArray

    def search(self, seconds: float = math.inf) -> Found:
        """The best plan found within a wall-clock limit, never worse than the last plan and the greedy one.

        A last plan that is expected to lose next to nothing stays without a search.

        Raises:
            ModuleNotFoundError: numba is not installed (extra ``service`` or ``planner``).
        """
        # Loading the search takes half a second, and only planning needs it. Without numba it would take minutes.
        from shared.kit.compiled import require_numba
        from shared.planning.annealing import Annealing

        require_numba()
        until = time.perf_counter() + seconds
        annealing = Annealing(self.problem)
        last = annealing.priced(with_fixed(self.problem, self.before))
        if last.expected_loss < _NEGLIGIBLE:
            return last
        greedy = annealing.priced(look_ahead(self.problem))
        starts = sorted((last, greedy), key=_loss)

        def run(number: int) -> Found:
            start, heat = RUNS[number]
            hot = max(heat * starts[0].expected_loss, _LEAST_HEAT)
            if len(self.uavs) <= _FEW_UAVS:
                return annealing.search(starts[start].actions, hot, number, until)
            return annealing.search(starts[start].actions, min(hot, _MOST_HEAT), number, until, times=2)

        best, left = starts[0], range(len(RUNS))
        if best.expected_loss < _WORTH_AT_ONCE:
            best, left = min(best, run(0), key=_loss), left[1:]
            if best.expected_loss < _WORTH_RUNS:
                return best
        with ThreadPoolExecutor(usable_cores()) as threads:
            return min([best, *threads.map(run, left)], key=_loss)


def _loss(found: Found) -> float:
    return found.expected_loss


class RecedingHorizon:
    """Plan eight steps ahead for the fleet, fly the first, and plan again.

    The objective is the expected number of packets lost in those steps and, without further visits, in at least four
    more: as many as the nearest UAV then needs to the sensor, at full speed; see
    :class:`~shared.planning.queue_chains.QueueChains`. A plan covers all UAVs that are present; the decisions already
    made in this step are fixed. In fleets of more than twelve UAVs, it covers the twelve that are nearest to those that
    need a decision; the next twelve keep their plans, which it takes into account.

    Simulated annealing (:class:`~shared.planning.annealing.Annealing`) searches in several runs, from the last plan and
    from that of :func:`shared.planning.greedy.look_ahead`, on all usable cores. If both are expected to lose a packet,
    six runs start together; otherwise one does, and five follow if its plan is expected to lose 0.1 packets. The last
    plan stays if it is expected to lose less than 0.003 packets. A mission repeats to the bit.

    Attributes:
        plans: by UAV, its planned actions ``(n, 2)``, sensor (-1: none) and velocity, from step ``step`` on.
        guidance: the next plans obey it.
    """

    def __init__(self, scenario: Scenario, belief: FleetBelief) -> None:
        self._scenario = scenario
        self._belief = belief
        self.guidance: Guidance = NO_GUIDANCE
        self.step = -1
        self.plans: dict[int, IntArray] = {}

    def begin(self, step: int) -> None:
        """Go to a later step: drop the plans' flown steps. The belief advances separately."""
        if step <= self.step:
            return
        self.plans = {uav: actions[step - self.step :] for uav, actions in self.plans.items()}
        self.step = step

    def copy(self) -> Self:
        """The planner with a belief of its own, so that another thread may draft and search a plan."""
        twin = copy(self)
        twin._belief, twin.plans = self._belief.copy(), dict(self.plans)
        return twin

    def draft(self, uavs: Collection[int], taken: Collection[int] = ()) -> Draft | None:
        """The problem of a plan for this step, in which these UAVs have no decision yet.

        Args:
            uavs: UAVs located in this step.
            taken: sensors reserved in this step, in addition to those of the belief's decisions.

        Returns:
            None if none of the UAVs flies its trajectory.
        """
        belief, step, world = self._belief, self.step, self._scenario
        present = [uav for uav in belief.present(step) if belief.uavs[uav].progress_m is not None]
        for uav, fastest in belief.drift.tops.items():
            if uav in self.plans:
                self.plans[uav] = np.minimum(self.plans[uav], [world.sensors, fastest])
        own = [uav for uav in uavs if uav in present]
        if not own:
            return None
        free, present = self._nearest(own, present)
        decided = {uav: action for uav, action in belief.decided(step).items() if uav in present}
        left = world.steps - step
        # A fleet may continue past the scenario's last step.
        horizon = min(_HORIZON, left if left > 0 else _HORIZON)
        fixed = {u: self.plans[u][:horizon] for u in present if u not in free and len(self.plans.get(u, ()))}
        fixed |= {u: np.array([action, *fixed.get(u, ())[1:]]) for u, action in decided.items()}
        kept = self._worth_planning(own, free, horizon)
        index = {int(sensor): k for k, sensor in enumerate(kept)}
        nowhere = len(kept)

        def renamed(actions: IntArray) -> IntArray:
            return np.array([(index.get(sensor, nowhere), v) for sensor, v in actions.tolist()], dtype=np.int64)

        # Sensors with flat batteries are barred, and those reserved in this step, except the belief's decisions.
        usable = np.tile(np.append(belief.battery[kept] > 0, True), (horizon, 1))
        usable[0, :-1] &= ~np.isin(kept, list(set(taken) - {sensor for sensor, _ in decided.values()}))
        links = self._links(present, kept, horizon)
        ahead = self._chances_ahead(present, kept, horizon)
        problem = FleetProblem(
            scenario=world,
            trajectories=[belief.trajectory(u) for u in present],
            progress_m=np.array([belief.uavs[u].progress_m for u in present], dtype=np.float64),
            places=np.concatenate((np.nan_to_num(belief.places[kept], nan=FAR_M), [[FAR_M, FAR_M]])),
            fixed={present.index(u): renamed(actions) for u, actions in fixed.items()},
            usable=usable,
            chains=self._chains(kept, horizon, ahead, free),
            stages=self._stages(ahead, horizon),
            **links,
            **self._outlook(kept, horizon),
            **self._guided(kept, horizon, free),
            tops=np.array([belief.drift.fastest([u], world.max_velocity) for u in present]),
        )
        before = np.empty((horizon, len(present), 2), dtype=np.int64)
        before[:] = nowhere, problem.levels[-1]
        for column, u in enumerate(present):
            last = self.plans.get(u, np.empty((0, 2), dtype=np.int64))[:horizon]
            before[: len(last), column] = renamed(last).reshape(-1, 2)
        return Draft(step, present, free, kept, problem, before)

    def adopt(self, draft: Draft, best: Found) -> None:
        """Fly this plan from now on, unless the fleet is at a later step."""
        if draft.step != self.step:
            return
        names = np.append(draft.kept, -1)
        for column, uav in enumerate(draft.uavs):
            if uav in draft.free:
                actions = best.actions[:, column]
                self.plans[uav] = np.stack((names[actions[:, 0]], actions[:, 1]), axis=-1)

    def action(self, uav: int, reserved: Collection[int] = ()) -> Action | None:
        """The planned sensor and velocity of a UAV now; if its plan names no sensor, the nearest one.

        ``None`` without a plan of this step, or if the sensor is reserved.
        """
        last, actions = self._belief.uavs.get(uav), self.plans.get(uav)
        if last is None or not self.step - 1 <= last.step <= self.step or actions is None or not len(actions):
            return None
        sensor, velocity = actions[0].tolist()
        if sensor < 0:
            distance = self._belief.distances(uav, np.array([velocity * self._scenario.step_s]))[0]
            distance[list(reserved)] = np.inf
            sensor = int(distance.argmin())
        return None if sensor in reserved else Action(sensor, velocity)

    def _nearest(self, own: list[int], present: list[int]) -> tuple[list[int], list[int]]:
        """The UAVs nearest to some that are among them: whose actions a plan chooses, and all that it has."""
        if len(present) <= JOINT_UAVS:
            return present, present
        at = np.array([self._belief.trajectory(uav).at(self._belief.uavs[uav].progress_m or 0.0) for uav in present])
        away = np.hypot(*(at[:, None] - at[[present.index(uav) for uav in own]]).T).min(axis=0)
        nearest = sorted(present, key=lambda uav: (uav not in own, away[present.index(uav)]))
        free = nearest[: max(JOINT_UAVS, len(own))]
        return sorted(free), sorted(nearest[: len(free) + _NEIGHBOURS])

    def _worth_planning(self, own: list[int], free: list[int], horizon: int) -> IntArray:
        """The sensors that ``free`` UAVs can reach in the steps that count; of too many, those that fill first.

        In a fleet that a plan does not cover, those come first that their ``own`` UAVs can reach within the horizon.
        """
        belief, world = self._belief, self._scenario
        ends = horizon * world.max_velocity
        near = self._within_radio(free, np.arange(ends + 1))
        ahead = self._within_radio(free, np.arange(ends, ends + _BEYOND[-1] * world.max_velocity + 1, _STRIDE))
        near |= not (near | ahead).any()
        ahead |= near
        room = (world.queue_capacity - belief.queue(self.step)) / np.maximum(belief.arrivals.rate, 1e-9)
        if self.guidance.wishes:
            # The operator's sensors come before those that fill first.
            ordered = np.isfinite(self.guidance.visit_intervals(world.sensors))
            room, near = np.where(ordered, -1.0, room), near | (ordered & ahead)
        order = np.lexsort((room, ~near, ~ahead))
        if world.uavs > JOINT_UAVS:
            mine = self._within_radio(own, np.arange(ends + 1))[order]
            first = order[mine][:_OWN_SENSORS]
            order = np.append(first, order[~np.isin(order, first)])
        most = _MOST_SENSORS[(world.uavs > _FEW_UAVS) + (world.uavs > JOINT_UAVS)]
        return np.sort(order[: min(int(ahead.sum()), most)])

    def _within_radio(self, uavs: list[int], sums: ArrayLike) -> NDArray[np.bool_]:
        """The sensors in radio range of one of these UAVs after velocities that sum to one of ``(n,)``."""
        metres = np.atleast_1d(sums) * self._scenario.step_s
        found = np.zeros(self._scenario.sensors, dtype=np.bool_)
        for uav in uavs:
            found |= (self._belief.distances(uav, metres) <= self._scenario.radio_radius_m).any(axis=0)
        return found

    def _links(self, present: list[int], kept: IntArray, horizon: int) -> dict[str, Any]:
        """The links of the fleet's UAVs, where the formula does not describe them."""
        belief, world = self._belief, self._scenario
        if belief.channel.by_formula and belief.drift.none:
            return {}
        metres = np.arange(horizon * world.max_velocity + 1) * world.step_s
        expected = [belief.links(uav, metres) for uav in present]
        nowhere = ((0, 0), (0, 1))
        return {
            "links": [np.pad(links.packets[:, kept], nowhere)[None] for links in expected],
            "chances": [np.pad(links.hold[:, kept], nowhere)[None] for links in expected],
        }

    def _outlook(self, kept: IntArray, horizon: int) -> dict[str, Any]:
        """The expected queues and arrivals of the kept sensors, and of one nowhere without packets."""
        world, belief, step = self._scenario, self._belief, self.step
        queue, rate, burst = belief.queue(step)[kept], belief.arrivals.rate[kept], belief.arrivals.burst(step)[kept]
        steps = np.arange(horizon + 1)[:, None]
        expected = np.rint(queue + steps * rate + burst * Arrivals.burst_over(steps)).astype(np.int64)
        return {
            "queue": np.append(np.minimum(expected[0], world.queue_capacity), 0),
            "battery": np.append(belief.battery[kept], 0.0),
            "arrivals": np.pad(np.diff(expected, axis=0), ((0, 0), (0, 1))),
        }

    def _stages(self, chances: list[FloatArray], horizon: int) -> list[IntArray]:
        """The stages after the horizon by the UAVs' ways to the kept sensors, over links of these chances."""
        fastest, ways = self._scenario.max_velocity, self._ways
        sums = horizon * fastest + 1
        best = np.max(chances, axis=(0, 1))
        stages = []
        for chance in chances:
            steps = steps_to(chance >= _GOOD_SHARE * best, _STRIDE, sums, fastest)
            stages.append(np.pad(np.minimum(np.searchsorted(ways, steps), len(ways) - 1), ((0, 0), (0, 1))))
        return stages

    def _chances_ahead(self, present: list[int], kept: IntArray, horizon: int) -> list[FloatArray]:
        """By UAV the chances of its links to the kept sensors, ``(P, n)``, at every stride of the way that counts."""
        sums = horizon * self._scenario.max_velocity + 1
        metres = np.arange(0, sums + _BEYOND[-1] * self._scenario.max_velocity, _STRIDE) * self._scenario.step_s
        links = [self._belief.links(uav, metres) for uav in present]
        return [(link.hold * (link.packets > 0))[:, kept] for link in links]

    def _chains(self, kept: IntArray, horizon: int, ahead: list[FloatArray], free: list[int]) -> QueueChains:
        """The queues' chains of the kept sensors, and of one nowhere without packets."""
        world, belief, step = self._scenario, self._belief, self.step
        arrivals = belief.arrivals
        rate, dispersion, base = arrivals.rate[kept], arrivals.dispersion, belief.base[kept]
        rate_variance = rate / arrivals.watched[kept]
        age = np.maximum(step - belief.since[kept], 0)
        came = arrivals.since(belief.since[kept], step, kept)
        soon = np.diff(Arrivals.burst_over(np.arange(horizon + 1)), axis=0)
        coming = rate + arrivals.burst(step)[kept] * soon[:, None]
        beyond = np.array(self._beyond(horizon))[:, None]
        best = np.max(ahead, axis=(0, 1))
        # The error of the rate is the same in all steps: of n steps it adds n times a step's variance to each.
        spread = coming * dispersion + rate_variance * horizon / 2
        chains = queue_chains(
            base=np.append(base, 0.0),
            base_variance=np.append(belief.base_variance[kept], 0.0),
            came=Arriving(np.append(came, 0.0), np.append(came * dispersion + age**2 * rate_variance, 0.0)),
            coming=Arriving(np.pad(coming, ((0, 0), (0, 1))), np.pad(spread, ((0, 0), (0, 1)))),
            later=Arriving(
                np.pad(beyond * rate, ((0, 0), (0, 1))),
                np.pad(beyond * rate * dispersion + beyond**2 * rate_variance, ((0, 0), (0, 1))),
            ),
            capacity=world.queue_capacity,
            best_chance=np.append(best, 1.0),
            # What a sensor with a flat battery loses is lost whatever the fleet does.
            weights=np.append(self.guidance.weights(world.sensors)[kept] * (belief.battery[kept] > 0), 1.0),
        )
        if self.guidance.wishes:
            away = ~self._within_radio(free, np.arange(horizon * world.max_velocity + 1)) & (belief.battery > 0)
            late = self.guidance.lateness_beyond(step + horizon, belief.visited, self._ways, int(beyond[0, 0])) * away
            chains.after[:, :-1] += late[:, kept, None]
        return chains

    @property
    def _ways(self) -> IntArray:
        """By stage, the steps at full speed from the plan's end to a sensor; single ones where orders may be late."""
        return np.arange(1, _BEYOND[-1] + 1) if self.guidance.wishes else np.array(_BEYOND)

    def _beyond(self, horizon: int) -> tuple[int, ...]:
        """By stage, the number of steps after the plan that count."""
        left, counted = self._scenario.steps - self.step, np.array(_BEYOND)[np.searchsorted(_BEYOND, self._ways)]
        return tuple(max(0, min(steps, left - horizon)) if left > 0 else steps for steps in counted.tolist())

    def _guided(self, kept: IntArray, horizon: int, free: list[int]) -> dict[str, Any]:
        """The part of the problem that the guidance and these UAVs' top speeds make, with one sensor nowhere."""
        orders, world, step = dict[str, Any](), self._scenario, self.step
        fastest = self._belief.drift.fastest(free, world.max_velocity)
        if self.guidance.restricts or fastest < world.max_velocity:
            allowed = self.guidance.allowed(world.max_velocity + 1)
            reached = allowed & (np.arange(len(allowed)) <= fastest)
            # Where the operator allows only velocities that no UAV reaches, they are still the orders.
            orders["allowed"] = reached if reached.any() else allowed
        if self.guidance.wishes:
            orders["weights"] = np.append(self.guidance.weights(world.sensors)[kept], 1.0)
            late = self.guidance.lateness(step, self._belief.visited, horizon, self._beyond(horizon)[0])
            orders["late"] = np.pad(late[:, :, kept], ((0, 0), (0, 0), (0, 1)))
        return orders
