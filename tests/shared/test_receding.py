"""A fleet's plan is searched again only where it is expected to lose packets."""

from __future__ import annotations

import numpy as np
import pytest

from shared.fleetplan import FleetBelief, Plan, RecedingHorizon
from shared.scenario import scenario_named

PAPER = scenario_named("paper").model_copy(update={"arrival_rate_min": 0.2, "arrival_rate_max": 0.4})
SENSORS = np.arange(PAPER.sensors)


def heard(queue: float, excess_db: float = 0.0) -> RecedingHorizon:
    """A planner at step 0; all sensors lie beside UAV 0's way, and have so many packets."""
    belief = FleetBelief(PAPER)
    for uav in range(PAPER.uavs):
        belief.locate(uav, 0, belief.trajectory(uav).at(0.0).tolist(), 0.0)
    places = belief.trajectory(0).at(np.linspace(0.0, 400.0, PAPER.sensors))
    belief.hear(
        SENSORS, places, np.zeros(PAPER.sensors, dtype=np.int64), np.full(PAPER.sensors, queue), np.full(10, 50.0)
    )
    if excess_db:
        gains = -belief.distances(0, np.zeros(1))[0] / 10.0 - 60.0 - excess_db
        belief.measure(0, SENSORS, gains)
    horizon = RecedingHorizon(PAPER, belief)
    horizon.begin(0)
    return horizon


def planned(horizon: RecedingHorizon) -> Plan:
    draft = horizon.draft([0, 1, 2])
    assert draft is not None
    found = draft.search()
    horizon.adopt(draft, found)
    return found


def test_a_plan_that_is_expected_to_lose_nothing_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    horizon = heard(queue=10.0)
    first = planned(horizon)
    assert first.objective < 1e-6

    def searched(*_: object, **__: object) -> Plan:
        raise AssertionError("a search that can save nothing")

    monkeypatch.setattr("shared.fleetplan.receding.plan", searched)
    again = planned(horizon)
    np.testing.assert_array_equal(again.actions, first.actions)
    assert again.work == 0.0


def test_over_uncertain_links_it_stays_too(monkeypatch: pytest.MonkeyPatch) -> None:
    horizon = heard(queue=2.0, excess_db=3.0)
    draft = horizon.draft([0])
    assert draft is not None and draft.problem.chains is not None
    first = planned(horizon)
    assert first.objective < 1e-6
    monkeypatch.setattr("shared.fleetplan.receding.searched", None)
    np.testing.assert_array_equal(planned(horizon).actions, first.actions)


@pytest.mark.parametrize(("queue", "least"), [(60.0, 0.05), (51.0, 0.005)])
def test_a_plan_that_loses_packets_is_searched(queue: float, least: float) -> None:
    # In bursty worlds plans that were expected to lose 0.01 packets, and so stayed, lost a hundred.
    horizon = heard(queue=queue)
    first = planned(horizon)
    assert first.objective > least and first.work > 0.0
    assert planned(horizon).work > 0.0
