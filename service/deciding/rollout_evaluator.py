"""The rollout evaluator: the packets that the fleet is expected to lose after a candidate, simulated from the belief.

It evaluates all advisers, so it must not be short-sighted: one step of look-ahead underrates an adviser that plans
further ahead. The method is a rollout (Tesauro and Galperin 1996; Bertsekas, Tsitsiklis and Wu 1997): fly the
candidate, let every UAV follow the LLM-free policy for some steps, and count the lost packets. Where there is a plan,
the candidate is also flown with the rest of the plan after its first step, and the lower loss counts. That makes it a
parallel rollout (Chang, Givan and Chong 2004). The plan's own action is evaluated with the plan's own continuation, as
in a fortified rollout (Bertsekas 2020, Rollout, Policy Iteration, and Distributed Reinforcement Learning). In the
model, which is the edge's belief, the best candidate is therefore expected to lose no more than the plan.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.deciding.rollout_state import RolloutState
from service.deciding.sampled_futures import SampledFutures
from shared.belief.fleet_belief import FleetBelief
from shared.world.actions import Action
from shared.world.channel import FloatArray
from shared.world.scenario import SCENARIOS

# Sampled futures. All candidates are flown through the same ones, so that arrivals cause no difference between them. On
# 8 worlds of scenario `paper`, flying the best candidate of an earlier evaluator lost 38 packets with 8 futures, 33
# with 24 and 30 with 48.
_FUTURES = 48
# Choices that one evaluation weighs at most; larger worlds get fewer futures.
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
    """Fly every candidate through the same sampled futures; takes a few milliseconds."""
    scenario, sensors, count = state.scenario, len(state.sensors), len(candidates)
    if not sensors:
        return Evaluation(np.zeros(count), np.ones(count))
    # Only mode ``guided`` needs the compiled flights.
    from service.deciding.rollout_flights import FlownWorld, fly_candidates

    uavs = list(state.links)
    plans = {uavs.index(uav): actions for uav, actions in state.plans.items()}
    continuations = [{}, plans] if plans else [{}]
    entries = count * sensors * (scenario.max_velocity + 1) * len(uavs) * state.horizon * len(continuations)
    futures = SampledFutures.of(state, int(np.clip(_MAX_ENTRIES // entries, 1, _FUTURES)))
    world = FlownWorld.of(state)
    index = {int(sensor): row for row, sensor in enumerate(state.sensors)}
    # A sensor that is not simulated is out of every UAV's reach.
    first = np.array([(index.get(sensor, -1), velocity) for sensor, velocity in candidates])
    flown = [fly_candidates(world, futures, uavs.index(state.uav), first, plans) for plans in continuations]
    return Evaluation(np.min([lost.mean(axis=1) for lost, _ in flown], axis=0), flown[-1][1].mean(axis=1))


def warm_up() -> None:
    """Compile the flights, or load what an earlier process has compiled, in advance."""
    scenario = SCENARIOS["paper"]
    belief = FleetBelief(scenario)
    x, y = (float(metres) for metres in belief.trajectory(0).at(0.0))
    belief.locate(0, 0, (x, y), 0.0)
    belief.places[0] = x, y
    evaluate(RolloutState.of(belief, scenario, 0, 0), [Action(0, 0)])
