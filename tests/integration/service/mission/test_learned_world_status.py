"""What a mission's status tells of the learned world, and what an older and a newer client make of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from service.api.mission_answers import learned_world
from shared.belief.fleet_belief import FleetBelief
from shared.wire.missions import MissionStatus
from shared.world.channel import channel_gain_db
from shared.world.scenario import SCENARIOS
from tests.integration.service.observability.test_metrics import numbers

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

PAPER = SCENARIOS["paper"]
# The excess losses of the four sensors that are heard, dB.
EXCESS_DB = [12.0, 0.4, -3.0, 5.0]


def measured(body: dict[str, Any], excess_db: list[float]) -> dict[str, Any]:
    """A report with the formula's gains less these excess losses."""
    sensors, (x, y) = body["sensors"], body["position"]
    away = np.hypot(np.array(sensors["x"]) - x, np.array(sensors["y"]) - y)
    gains = channel_gain_db(away[:4], PAPER) - np.array(excess_db)
    return {**body, "sensors": {**sensors, "channel_gain": [*gains.tolist(), None]}}


def test_a_world_that_equals_the_formula_tells_nothing(edge: Edge, report: Report) -> None:
    client = edge()
    assert "learned" not in client.put("/missions/test", json={}).json()
    assert client.post("/decide", json=measured(report(), [0.0] * 4)).status_code == 200
    # The keys of an earlier version, so that its clients read it.
    assert client.get("/missions/test").json().keys() == MissionStatus.model_fields.keys() - {
        "learned",
        "deadlines",
        "names",
        "alarms",
        "readings",
    }


def test_the_status_tells_what_differs(edge: Edge, report: Report) -> None:
    client, outcome = edge(), None
    for step in range(4):
        body = measured(report(step=step), EXCESS_DB)
        answer = client.post("/decide", json=body if outcome is None else {**body, "outcome": outcome}).json()
        outcome = {"decision_id": answer["decision_id"], "cost": 1.0, "failed": True}
    learned = client.get("/missions/test").json()["learned"]
    assert learned["excess_db"] == pytest.approx({"0": 12.0, "2": -3.0, "3": 5.0})
    assert (learned["rate_share"], learned["wind"]) == (1.0, [0.0, 0.0])
    assert learned["deviation_db"] > 2.0
    assert 0.0 < learned["offset_db"] < 6.0
    status = MissionStatus.model_validate_json(client.get("/missions/test").content)
    assert status.learned is not None
    assert status.learned.excess_db[0] == pytest.approx(12.0)


def test_the_status_names_failed_radios_wind_bursts_and_the_rate() -> None:
    belief = FleetBelief(PAPER)
    assert learned_world(belief) is None
    for _ in range(2):
        belief.channel.failures.settle(3, failed=True)
    for _ in range(5):
        belief.channel.moved(30.0, 60.0, 60, 5.0)
    belief.drift.learn(belief.trajectory(0), 0.0, 100.0, 150.0)
    every, one = np.arange(10), np.ones(10, dtype=np.int64)
    for step in range(1, 41):
        belief.arrivals.take(every, np.full(10, 20.0 * (step % 4 == 0)), one, one * step)
    learned = learned_world(belief)
    assert learned is not None
    assert learned.failed_radios == [3]
    assert learned.rate_share == pytest.approx(0.5)
    # The lap begins to the north.
    assert learned.wind[1] > 0.1 > abs(learned.wind[0])
    assert learned.dispersion > 2.0
    assert learned.excess_db == {}


def test_a_client_reads_the_status_of_a_newer_edge(edge: Edge) -> None:
    reported = edge().put("/missions/test", json={}).json()
    newer = {**reported, "learned": None, "something_new": [1, 2]}
    assert MissionStatus.model_validate_json(httpx.Response(200, json=newer).content).mission_id == "test"


def test_metrics_count_excess_losses_and_failures_over_good_links(edge: Edge, report: Report) -> None:
    client, outcome = edge(), None
    for step in range(3):
        body = measured(report(step=step), EXCESS_DB)
        answer = client.post("/decide", json=body if outcome is None else {**body, "outcome": outcome}).json()
        outcome = {"decision_id": answer["decision_id"], "cost": 1.0, "failed": True}
    # Sent again, it counts once.
    client.post("/decide", json=body)
    reported = numbers(client)
    assert reported["aicvds_link_excess_db_count"] == 12
    assert reported['aicvds_link_excess_db_bucket{le="-6.0"}'] == 0
    assert reported['aicvds_link_excess_db_bucket{le="1.0"}'] == 6
    assert reported['aicvds_link_excess_db_bucket{le="10.0"}'] == 9
    assert reported["aicvds_radio_failures_total"] == 2
