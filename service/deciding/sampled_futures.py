"""Sampled futures for the rollout evaluator: queues, arrivals and links drawn from the belief."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.deciding.rollout_state import RolloutState
from shared.world.channel import FloatArray


@dataclass(frozen=True, slots=True)
class SampledFutures:
    """M futures sampled from the belief: queues ``(M, n)``, arrivals ``(H, M, n)``, and the sensors' fades ``(M, n)``.

    A fade is the excess of a sensor's path losses over their means, in standard deviations, the same in all steps:
    infinite where the radio is dead.
    """

    start: FloatArray
    arrivals: FloatArray
    fades: FloatArray

    @classmethod
    def of(cls, state: RolloutState, count: int) -> SampledFutures:
        """Sample futures, each with its own arrival rates, because a rarely heard sensor may fill fast."""
        scenario, shape = state.scenario, (count, len(state.sensors))
        random = np.random.default_rng(state.seed)
        capacity = float(scenario.queue_capacity)
        rates = random.gamma(state.arrived, 1.0 / state.watched, shape)
        fewest, most = scenario.initial_queue_min * capacity, scenario.initial_queue_max * capacity
        drawn = random.uniform(fewest, most, shape)
        start = np.where(state.unknown, drawn, state.queue) + random.poisson(rates * state.age)
        expected = rates
        if state.dispersion > 1.0:
            # A Poisson number of a Gamma mean has a variance above its mean.
            spread = state.dispersion - 1.0
            expected = random.gamma(np.maximum(rates + state.bursts[:, None], 1e-9) / spread, spread)
        arrivals = random.poisson(expected, (state.horizon, *shape)).astype(np.float64)
        fades = np.where(random.uniform(size=shape) < state.alive, random.standard_normal(shape), np.inf)
        return cls(np.minimum(start, capacity), arrivals, fades)
