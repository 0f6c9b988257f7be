"""How urgent a sensor's packets are, by the packets in its queue."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.scenario import Scenario
from shared.world.urgency import urgency, urgency_by_level

RATES = np.array([0.0, 0.3, 5.0, 90.0, 250.0, 700.0])


@pytest.mark.parametrize("capacity", [1, 60, 2_000])
def test_the_urgency_of_every_level_is_that_of_a_queue_with_as_many_packets(capacity: int) -> None:
    world = Scenario(name="any", sensors=1, uavs=1, queue_capacity=capacity)
    levels = np.arange(capacity + 1, dtype=np.float64)[:, None]
    np.testing.assert_array_equal(urgency_by_level(RATES, world), urgency(levels, RATES, world))


def test_the_urgency_of_a_huge_queues_levels_needs_no_sum_for_each() -> None:
    # A sum for each level would have 10 billion terms.
    world = Scenario(name="any", sensors=1, uavs=1, queue_capacity=100_000)
    found = urgency_by_level(np.full(8, 5_000.0), world)
    assert found.shape == (100_001, 8) and found[0, 0] < 1e-9 < 0.99 < found[-1, 0]
    assert (np.diff(found, axis=0) >= 0).all()
