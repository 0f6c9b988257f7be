"""The compiled flights of the rollout evaluator, beside the same flights in plain Python."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from service.deciding import rollout_evaluator
from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState, SampledFutures
from shared.planning.orders import LATE_PACKETS, Guidance, SensorWish
from shared.world.scenario import SCENARIOS
from shared.world.step_rule import Action
from shared.world.urgency import VELOCITY_BONUS, urgency

WORLD = SCENARIOS["paper"].model_copy(update={"sensors": 12, "queue_capacity": 40, "max_velocity": 3, "uavs": 3})
HORIZON, SENSORS, VELOCITIES = 5, 7, 4
SUMS = HORIZON * (VELOCITIES - 1) + 1
# UAV 2 decides; UAV 0 has decided in this step, and UAV 1 has no plan.
UAVS = (2, 0, 1)
FUTURES = 6
CANDIDATES = [Action(2, 1), Action(11, 3), Action(5, 0), Action(9, 2), Action(1, 0)]


def state_of(seed: int, guidance: Guidance, *, uncertain: bool, planned: bool) -> RolloutState:
    """A random state of seven of twelve sensors: links in half of the places, some over their thresholds."""
    random = np.random.default_rng(seed)
    shape = SUMS, SENSORS
    links = {uav: np.floor(random.uniform(-20, 20, shape)).clip(min=0) for uav in UAVS}
    # Sensor 3 is out of every reach, and no sensor is out of UAV 1's.
    for uav in UAVS:
        links[uav][:, 3] = 0.0 if uav != 1 else 9.0
        links[uav][:, 6] = links[uav][:, 5]
    margins = {uav: random.normal(0.5, 1.0, shape) for uav in UAVS if uncertain}
    queue, arrived = random.integers(0, 40, SENSORS).astype(np.float64), random.uniform(4.0, 40.0, SENSORS)
    unknown, age = random.uniform(size=SENSORS) < 0.3, random.integers(0, 3, SENSORS)
    # Sensors 5 and 6 are worth the same in the first step: the first is chosen.
    queue[5:], arrived[5:], unknown[5:], age[5:] = 30.0, 20.0, False, 0
    plans = {
        uav: np.stack((random.integers(-1, SENSORS, 4), random.integers(0, VELOCITIES, 4)), axis=1) for uav in UAVS
    }
    return RolloutState(
        scenario=WORLD,
        uav=UAVS[0],
        horizon=HORIZON,
        seed=(seed, 0, 0),
        sensors=np.array([1, 2, 4, 5, 7, 9, 11]),
        queue=queue,
        unknown=unknown,
        age=age,
        burst_before=np.zeros(SENSORS),
        arrived=arrived,
        watched=np.full(SENSORS, 4.0),
        dispersion=1.0 if seed % 2 else 2.5,
        bursts=np.zeros((HORIZON, SENSORS)),
        links=links,
        margins=margins,
        holds={uav: 1.0 / (1.0 + np.exp(-1.7 * margin)) for uav, margin in margins.items()},
        alive=np.where(np.arange(SENSORS) == 4, 0.3, 1.0),
        decided={0: 2},
        reserved=np.arange(SENSORS) == 1,
        plans={uav: actions[: 2 + uav] for uav, actions in plans.items() if planned and uav != 1},
        guidance=guidance,
        step=6,
        visited=random.integers(-1, 6, WORLD.sensors),
    )


class PlainFlight:
    """One flight of a candidate through a future, one number at a time."""

    def __init__(self, state: RolloutState, futures: SampledFutures, future: int, planned: bool) -> None:
        self.state, self.plans = state, state.plans if planned else {}
        self.queue, self.fades = futures.start[future].tolist(), futures.fades[future]
        self.arrivals = futures.arrivals[:, future]
        self.flown = dict.fromkeys(state.links, 0)
        self.waited = [state.step - int(state.visited[sensor]) for sensor in state.sensors]

    def link(self, uav: int, sensor: int, velocity: int) -> float:
        at = self.flown[uav] + velocity, sensor
        margins = self.state.margins.get(uav)
        return float(self.state.links[uav][at]) if margins is None or margins[at] > self.fades[sensor] else 0.0

    def transfer(self, uav: int, sensor: int, velocity: int, served: set[int]) -> bool:
        """Fly, and collect from a sensor if there is one; returns whether that succeeds."""
        packets = self.link(uav, sensor, velocity) if sensor >= 0 else 0.0
        self.flown[uav] += velocity
        if packets == 0.0 or sensor in served:
            return False
        self.queue[sensor] = max(self.queue[sensor] - packets, 0.0)
        self.waited[sensor] = 0
        served.add(sensor)
        return True

    def look_ahead(self, uav: int, served: set[int]) -> tuple[int, int]:
        state, best, choice = self.state, -math.inf, (0, 0)
        weights = state.guidance.weights(WORLD.sensors)[state.sensors]
        reach = np.flatnonzero((state.links[uav] > 0).any(axis=0)).tolist()
        # Where nothing is in reach it flies on and names a sensor that it cannot reach.
        beyond = [sensor for sensor in range(SENSORS) if sensor not in reach][:1]
        for sensor in sorted(reach + beyond):
            urgent = float(urgency(np.floor(self.queue[sensor]), state.rates, WORLD)[sensor] * weights[sensor])
            for velocity in np.flatnonzero(state.guidance.allowed(VELOCITIES)).tolist():
                at = self.flown[uav] + velocity, sensor
                moved = 0.0 if sensor in served else min(float(state.links[uav][at]), self.queue[sensor])
                hold = float(state.holds[uav][at]) if uav in state.holds else 1.0
                if (worth := moved * hold * urgent + VELOCITY_BONUS * velocity) > best:
                    best, choice = worth, (sensor, velocity)
        return choice

    def fly(self, sensor: int, velocity: int) -> tuple[float, float]:
        """Packets lost, and the cost of the candidate's step."""
        state, own, lost, cost = self.state, self.state.uav, 0.0, 0.0
        orders, which = state.guidance, state.sensors
        weights, intervals = orders.weights(WORLD.sensors)[which], orders.visit_intervals(WORLD.sensors)[which]
        in_reach = [self.link(own, j, velocity) > 0 for j in range(SENSORS)]
        for step in range(state.horizon):
            served = set(np.flatnonzero(state.reserved).tolist()) if step == 0 else set()
            for uav in state.links:
                if step == 0 and uav == own:
                    cost += not self.transfer(own, sensor, velocity, served)
                elif step == 0 and uav in state.decided:
                    self.flown[uav] += state.decided[uav]
                elif step < len(self.plans.get(uav, ())):
                    planned_sensor, planned_velocity = self.plans[uav][step].tolist()
                    self.transfer(uav, planned_sensor, planned_velocity, served)
                else:
                    self.transfer(uav, *self.look_ahead(uav, served), served)
            for j in range(SENSORS):
                over = max(self.queue[j] + self.arrivals[step, j] - WORLD.queue_capacity, 0.0)
                self.queue[j] += self.arrivals[step, j] - over
                lost += over * weights[j] + LATE_PACKETS * (self.waited[j] >= intervals[j])
                self.waited[j] += 1
                cost += over / WORLD.queue_capacity if step == 0 and in_reach[j] else 0.0
        return lost, cost


ORDERS = Guidance(
    sensors=[SensorWish(sensor_id=4, visit_every=2), SensorWish(sensor_id=9, weight=2.5)], forbidden_velocities=[1]
)


@pytest.mark.parametrize("guidance", [Guidance(), ORDERS], ids=["free", "ordered"])
@pytest.mark.parametrize("uncertain", [False, True], ids=["certain", "uncertain"])
@pytest.mark.parametrize("planned", [False, True], ids=["unplanned", "planned"])
def test_it_flies_as_plain_python_does(
    guidance: Guidance, uncertain: bool, planned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout_evaluator, "FUTURES", FUTURES)
    for seed in range(2):
        state = state_of(seed, guidance, uncertain=uncertain, planned=planned)
        found, futures = evaluate(state, CANDIDATES), SampledFutures.of(state, FUTURES)
        rows = [int(np.flatnonzero(state.sensors == sensor)[0]) for sensor, _ in CANDIDATES]
        for at, (row, (_, velocity)) in enumerate(zip(rows, CANDIDATES, strict=True)):
            means = [
                np.mean([PlainFlight(state, futures, m, plans).fly(row, velocity) for m in range(FUTURES)], axis=0)
                for plans in sorted({False, planned})
            ]
            assert found.lost[at] == pytest.approx(min(lost for lost, _ in means))
            assert found.cost[at] == pytest.approx(means[-1][1])


def test_a_sensor_out_of_every_reach_is_a_failed_visit() -> None:
    state = state_of(0, Guidance(), uncertain=False, planned=False)
    found = evaluate(state, [Action(0, 2)])
    assert found.cost[0] >= 1.0


def test_where_nothing_is_in_reach_nothing_is_lost() -> None:
    state, nothing = state_of(0, Guidance(), uncertain=False, planned=False), np.zeros(0, dtype=np.int64)
    alone = replace(state, sensors=nothing, links={uav: table[:, nothing] for uav, table in state.links.items()})
    found = evaluate(alone, [Action(0, 2)])
    assert (found.lost.tolist(), found.cost.tolist()) == ([0.0], [1.0])
