"""The rollout evaluator: the packets that the fleet is expected to lose after a candidate, simulated from the belief.

It evaluates all advisers, so it must not be short-sighted: one step of look-ahead underrates an adviser that plans
further ahead. The method is a rollout (Tesauro and Galperin 1996; Bertsekas, Tsitsiklis and Wu 1997): fly the
candidate, let every UAV follow the LLM-free policy for some steps, and count the lost packets. Where there is a plan,
the candidate is also flown with the rest of the plan after its first step, and the lower loss counts. That makes it a
parallel rollout (Chang, Givan and Chong 2004). The plan's own action is evaluated with the plan's own continuation, as
in a fortified rollout (Bertsekas 2020, Rollout, Policy Iteration, and Distributed Reinforcement Learning). In the
model, which is the edge's belief, the best candidate is therefore expected to lose no more than the plan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from service.deciding.rollout_state import RolloutState
from service.deciding.sampled_futures import SampledFutures
from shared.actions import Action
from shared.channel import FloatArray
from shared.features import VELOCITY_BONUS, urgency
from shared.guidance import Waiting

# Sampled futures. All candidates are flown through the same ones, so that arrivals cause no difference between them. On
# 8 worlds of scenario `paper`, flying the best candidate of an earlier evaluator lost 38 packets with 8 futures, 33
# with 24 and 30 with 48.
_FUTURES = 48
# Array entries of one evaluation, with the sensors out of reach; larger worlds get fewer futures.
_MAX_ENTRIES = 20_000_000


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Expectations for C candidates, ``(C,)`` each.

    ``lost``: packets that the fleet loses over the horizon. ``cost``: the cost of the step as the UAV will report it,
    ``f + lost / W`` of the sensors in its reach.
    """

    lost: FloatArray
    cost: FloatArray


def evaluate(state: RolloutState, candidates: Sequence[Action]) -> Evaluation:
    """Fly every candidate through the same sampled futures; takes milliseconds to tens of milliseconds."""
    scenario, sensors, count = state.scenario, len(state.sensors), len(candidates)
    entries = count * max(1, sensors) * (scenario.max_velocity + 1) * len(state.links) * state.horizon
    continuations = [{}, state.plans] if state.plans else [{}]
    futures = SampledFutures.of(state, int(np.clip(_MAX_ENTRIES // (entries * len(continuations)), 1, _FUTURES)))
    # A sensor that is not simulated is out of every UAV's reach: its link never holds.
    rows = np.searchsorted(state.sensors, [sensor for sensor, _ in candidates])
    known = np.isin([sensor for sensor, _ in candidates], state.sensors)
    first = np.stack((np.where(known, rows, 0), [v for _, v in candidates]), axis=1)
    losses = []
    for plans in continuations:
        world = _RolloutBatch(state, np.tile(futures.start, (count, 1)), np.tile(futures.fades, (count, 1)), plans)
        many = len(futures.start)
        cost = world.fly_first(np.repeat(first, many, axis=0), np.repeat(known, many))
        lost = world.arrive(np.tile(futures.arrivals[0], (count, 1)))
        cost += world.overflow_in_reach / scenario.queue_capacity
        for step in range(1, state.horizon):
            world.fly(step)
            lost += world.arrive(np.tile(futures.arrivals[step], (count, 1)))
        losses.append(lost.reshape(count, many).mean(axis=1))
    return Evaluation(np.min(losses, axis=0), cost.reshape(count, many).mean(axis=1))


class _Offers(NamedTuple):
    """One UAV's choice in a step of look-ahead, after each sum S of velocities.

    Attributes:
        sensors: shape ``(m,)``, those that it may reach within the horizon, and one that it may not, if there is one.
        packets: shape ``(S, m, V)``, that one more step at each velocity can move.
        holds: shape ``(S, m, V)``, the probability that the link holds; None: 1.
    """

    sensors: NDArray[np.int64]
    packets: FloatArray
    holds: FloatArray | None


class _RolloutBatch:
    """B copies of the state: queues ``(B, n)``, and the sum of each UAV's velocities so far."""

    def __init__(
        self, state: RolloutState, queue: FloatArray, fades: FloatArray, plans: Mapping[int, NDArray[np.int64]]
    ) -> None:
        self._state = state
        self._plans = plans
        scenario = state.scenario
        self._capacity = float(scenario.queue_capacity)
        guidance, fast = state.guidance, np.arange(scenario.max_velocity + 1, dtype=np.float64)
        self._bonus = np.where(guidance.allowed(len(fast)), VELOCITY_BONUS * fast, -np.inf)
        self._weights = guidance.weights(scenario.sensors)[state.sensors]
        self._waiting = (
            Waiting(guidance, state.sensors, state.step, state.visited, len(queue)) if guidance.wishes else None
        )
        levels = np.arange(scenario.queue_capacity + 1, dtype=np.float64)[:, None]
        self._urgency = urgency(levels, state.rates, scenario)
        # By UAV, shape (sum of velocities so far + 1, n, V): packets that one more step at each velocity can move, and
        # the margins of its links.
        self._ahead = {uav: self._windows(table) for uav, table in state.links.items()}
        self._margins = {uav: self._windows(table) for uav, table in state.margins.items()}
        self._offered = {uav: self._offers(uav) for uav in state.links} if len(state.sensors) else {}
        self._fades = fades
        self._flown = {uav: np.zeros(len(queue), dtype=np.int64) for uav in self._ahead}
        self._queue = queue
        self._rows, self._columns = np.arange(len(queue)), np.arange(queue.shape[1])
        self._in_reach = np.zeros_like(queue, dtype=np.bool_)
        self.overflow_in_reach: FloatArray = np.zeros(len(queue))

    def fly_first(self, first: NDArray[np.int64], collects: NDArray[np.bool_]) -> FloatArray:
        """Fly the candidates' step, ``(B, 2)``, with the others' decisions, plans or policy; returns f, ``(B,)``."""
        state, own = self._state, self._state.uav
        served = np.tile(state.reserved, (len(first), 1))
        failed: FloatArray = np.ones(len(first))
        velocity = first[:, 1]
        if len(self._columns):
            ahead = self._ahead[own][0].T[velocity]
            if own in self._margins:
                ahead = np.where(self._margins[own][0].T[velocity] > self._fades, ahead, 0.0)
            self._in_reach = ahead > 0
            served_now = self._serve(first[:, 0], np.where(collects, ahead[self._rows, first[:, 0]], 0.0), served)
            failed = np.where(served_now, 0.0, 1.0)
        self._flown[own] += velocity
        for uav in self._ahead:
            if uav in state.decided:
                # The state's queues are already without the packets of this decision.
                self._flown[uav] += state.decided[uav]
            elif uav != own:
                self._continue(uav, 0, served)
        return failed

    def fly(self, step: int) -> None:
        """Fly the step that is ``step`` steps after the candidates'."""
        served = np.zeros_like(self._queue, dtype=np.bool_)
        for uav in self._ahead:
            self._continue(uav, step, served)

    def _continue(self, uav: int, step: int, served: NDArray[np.bool_]) -> None:
        """Fly the plan's step from the UAV's position, or the policy's where the plan is shorter."""
        planned = self._plans.get(uav, ())
        if step >= len(planned) or not len(self._columns):
            self._look_ahead(uav, served)
            return
        sensor, velocity = planned[step]
        if sensor >= 0:
            sensors = np.full(len(self._rows), sensor)
            self._serve(sensors, self._link(uav, sensors, velocity), served)
        self._flown[uav] += velocity

    def arrive(self, arrivals: FloatArray) -> FloatArray:
        """Add arrivals; returns the weighted overflow and the cost of late visits, ``(B,)`` packets."""
        filled = self._queue + arrivals
        self._queue = np.minimum(filled, self._capacity)
        over = filled - self._queue
        self.overflow_in_reach = np.asarray(np.where(self._in_reach, over, 0.0).sum(axis=1))
        late = 0.0 if self._waiting is None else self._waiting.end_step()
        return np.asarray((over * self._weights).sum(axis=1) + late)

    def _windows(self, table: FloatArray) -> FloatArray:
        """The table ``(C, n)`` at one more step of each velocity, ``(C - V + 1, n, V)``."""
        return sliding_window_view(table, len(self._bonus), axis=0)

    def _offers(self, uav: int) -> _Offers:
        """What look-ahead chooses from."""
        near = np.asarray((self._state.links[uav] > 0).any(axis=0))
        # All sensors out of reach are alike, and of equal ones the first is chosen.
        near[(~near).argmax()] = True
        some = np.flatnonzero(near)
        holds = self._state.holds.get(uav)
        tables = [self._state.links[uav], *([] if holds is None else [holds])]
        packets, *likely = (np.ascontiguousarray(self._windows(table[:, some])) for table in tables)
        return _Offers(some, packets, likely[0] if likely else None)

    def _look_ahead(self, uav: int, served: NDArray[np.bool_]) -> None:
        """One step of look-ahead, as in :func:`service.deciding.advisers.look_ahead`."""
        if not len(self._columns):
            return
        offers, flown = self._offered[uav], self._flown[uav]
        some = offers.sensors
        queue = self._queue[:, some]
        urgencies = self._urgency[queue.astype(np.int64), some] * self._weights[some]
        # In place, because the arrays are large.
        worth = offers.packets.take(flown, axis=0)
        np.minimum(worth, np.where(served[:, some], 0.0, queue)[..., None], out=worth)
        if offers.holds is not None:
            worth *= offers.holds.take(flown, axis=0)
        worth *= urgencies[..., None]
        worth += self._bonus
        best, velocity = np.unravel_index(worth.reshape(len(worth), -1).argmax(axis=1), worth.shape[1:])
        sensor = some[best]
        self._serve(sensor, self._link(uav, sensor, velocity), served)
        self._flown[uav] += velocity

    def _link(self, uav: int, sensor: NDArray[np.int64], velocity: NDArray[np.int64] | int) -> FloatArray:
        """Packets ``(B,)`` that one more step at a velocity can move from sensors ``(B,)``, 0 where the link fails."""
        at = self._flown[uav], sensor, velocity
        link = self._ahead[uav][at]
        if uav not in self._margins:
            return np.asarray(link)
        return np.asarray(np.where(self._margins[uav][at] > self._fades[self._rows, sensor], link, 0.0))

    def _serve(self, sensor: NDArray[np.int64], link: FloatArray, served: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Move packets from sensors ``(B,)`` over links with these capacities; returns where that succeeds."""
        holds = (link > 0) & ~served[self._rows, sensor]
        waiting = self._queue[self._rows, sensor]
        self._queue[self._rows, sensor] = waiting - np.where(holds, np.minimum(waiting, link), 0.0)
        served[self._rows, sensor] |= holds
        if self._waiting is not None:
            self._waiting.visit(sensor, holds)
        return holds
