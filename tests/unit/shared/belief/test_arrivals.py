"""The arrivals: rates, whether they come in bursts, and what a stored state keeps of them."""

from __future__ import annotations

import numpy as np
import pytest

from shared.belief.arrivals import Arrivals
from shared.world.channel import IntArray
from shared.world.scenario import SCENARIOS, Scenario

WORLD = Scenario(name="ten", sensors=10, uavs=2)
ALL = np.arange(10)
ONE_STEP = np.ones(10, dtype=np.int64)


def reported(came: IntArray) -> Arrivals:
    """The arrivals after beacons in every step; ``came``, ``(T, 10)``, packets."""
    arrivals = Arrivals(WORLD)
    for step, row in enumerate(came):
        arrivals.take(ALL, row.astype(np.float64), ONE_STEP, ONE_STEP * (step + 1))
    return arrivals


def poisson(steps: int = 200) -> IntArray:
    return np.random.default_rng(0).poisson(5.0, (steps, 10))


def bursts(steps: int = 200) -> IntArray:
    """Eight steps of twelve packets after twenty-four of one."""
    return np.where((np.arange(steps) % 32 < 8)[:, None], 12, 1) * np.ones(10, dtype=np.int64)


@pytest.mark.parametrize("steps", [0, 1, 5, 20, 200])
def test_poissons_arrivals_have_no_bursts_to_the_bit(steps: int) -> None:
    arrivals = reported(poisson(steps))
    assert arrivals.dispersion == 1.0
    assert not arrivals.burst(steps).any()
    np.testing.assert_array_equal(arrivals.coming(steps, 8.0, ALL), arrivals.rate)


def test_bursts_are_seen_and_go_on_for_a_while() -> None:
    in_burst, after = reported(bursts(196)), reported(bursts(216))
    assert in_burst.dispersion > 2.0
    soon = in_burst.burst(196)
    assert (soon > 3.0).all()
    assert (in_burst.burst(206) < 0.1 * soon).all()
    assert (in_burst.coming(196, 8.0, ALL) > in_burst.rate + 0.5).all()
    # A sensor that has less than its rate now expects its rate.
    np.testing.assert_array_equal(after.burst(216), 0.0)


def test_a_bursts_packets_come_in_the_next_steps_and_no_more_than_all_of_them() -> None:
    share = Arrivals.burst_over(np.arange(40))
    assert share[0] == 0.0
    assert (np.diff(share) > 0).all()
    assert share[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("came", [poisson(), bursts()])
def test_a_restored_state_goes_on_to_the_bit(came: IntArray) -> None:
    whole, again = reported(came), Arrivals(WORLD)
    again.load_state_dict(reported(came[:100]).state_dict())
    for step, row in enumerate(came[100:], 100):
        again.take(ALL, row.astype(np.float64), ONE_STEP, ONE_STEP * (step + 1))
    assert again.dispersion == whole.dispersion
    for ours, theirs in ((whole.rate, again.rate), (whole.burst(200), again.burst(200))):
        np.testing.assert_array_equal(ours, theirs)


def test_where_nothing_is_expected_nothing_is_no_surprise_and_a_packet_is_no_burst() -> None:
    nothing = SCENARIOS["paper"].model_copy(update={"arrival_rate_min": 0.0, "arrival_rate_max": 0.0})
    arrivals, ids = Arrivals(nothing), np.arange(10)
    for step in range(1, 10):
        arrivals.take(ids, np.zeros(10), np.ones(10, dtype=np.int64), np.full(10, step))
    arrivals.take(ids[:1], np.ones(1), np.ones(1, dtype=np.int64), np.array([10]))
    assert arrivals.dispersion == 1.0
    assert not arrivals.burst(11).any()
