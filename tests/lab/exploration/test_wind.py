"""The clairvoyant bound in wind, compared with an exhaustive search."""

from __future__ import annotations

import pytest

from lab.exploration.wind import bound_in_wind
from simulator.bound.clairvoyant_bound import replay
from tests.unit.simulator.bound.test_clairvoyant_bound import least_by_flying, small


@pytest.mark.parametrize("seed", range(2))
def test_in_wind_the_bound_is_below_every_flight(seed: int) -> None:
    site = small(sensors=2, steps=2, wind_mps=1.0, gust_mps=0.5, shadowing_db=6.0, step_s=60.0)
    bound = bound_in_wind(site, seed, time_limit_s=10)
    assert bound.lower_bound <= least_by_flying(site, seed) <= bound.lost_packets
    assert replay(site, seed, bound.actions) == bound.lost_packets
