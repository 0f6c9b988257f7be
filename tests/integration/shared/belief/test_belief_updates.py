"""The belief's compiled functions compute what the formulas do, with and without numba."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from shared.belief.arrivals import GOES_ON
from shared.belief.fleet_belief import FleetBelief
from shared.belief.learned_channel import ExpectedLinks
from shared.belief.records import Records, take_report
from shared.wire.schemas import SensorColumns, UavState
from shared.world.channel import FloatArray, IntArray, Links
from shared.world.scenario import SCENARIOS, Scenario

WORLD = Scenario(name="ten", sensors=10, uavs=2)
# The last queues of a fleet that hears beacons in random order; with an argument numba is missing.
HEARD = """
import json, sys
if len(sys.argv) > 1:
    sys.modules["numba"] = None
from tests.integration.shared.belief.test_belief_updates import flown
belief, records = flown(40)
print(json.dumps([belief.queue(41).tolist(), belief.arrivals.burst(41).tolist(), records.rates.tolist()]))
"""


def report(step: int) -> UavState:
    """Some of the sensors, with beacons of this step and of earlier ones, and some that were never heard."""
    random = np.random.default_rng(step)
    ids = np.sort(random.choice(10, random.integers(1, 10), replace=False))
    seen = [int(s) if s >= 0 else None for s in step - random.integers(0, 4, len(ids))]
    columns = {
        "queue": random.integers(0, 61, len(ids)).tolist(),
        "battery": random.uniform(0, 50, len(ids)).tolist(),
        "channel_gain": random.uniform(-110, -80, len(ids)).tolist(),
    }
    known = {
        name: [None if s is None else float(v) for v, s in zip(c, seen, strict=True)] for name, c in columns.items()
    }
    places = {axis: (100.0 * ids + step % 3).tolist() for axis in ("x", "y")}
    sensors = SensorColumns.model_validate({"id": ids.tolist(), "last_seen": seen, **places, **known})
    return UavState(uav_id=step % 2, position=[480.0 + step, 450.0], sensors=sensors)


def flown(steps: int) -> tuple[FleetBelief, Records]:
    """A belief and records after so many reports, with decisions and outcomes."""
    belief, records = FleetBelief(WORLD), Records(WORLD)
    for step in range(steps):
        take_report(report(step), step, records, belief)
        belief.record_decision(step % 2, step, step % 10, 7)
        records.presume(step % 10, str(step), step)
        belief.settle(step % 2, step, step % 3 == 0)
    return belief, records


def heard(belief: FleetBelief, step: int) -> tuple[IntArray, FloatArray, IntArray]:
    """The sensors of a step's report, their queues and the steps of their beacons, -1 for none."""
    sensors = report(step).sensors
    seen = [-1 if s is None else s for s in sensors.last_seen]
    return np.array(sensors.id), np.array([q or 0.0 for q in sensors.queue]), np.array(seen)


@pytest.mark.parametrize("step", range(1, 40))
def test_newer_beacons_count_and_show_arrivals_unless_a_visit_left_packets(step: int) -> None:
    belief, records = flown(step)
    belief.advance(step)
    ids, queue, seen = heard(belief, step)
    arrivals, since, base = belief.arrivals, belief.since[ids], belief.base[ids]
    # The queue before the visit from which a sensor's is known says less than that visit.
    visited = belief.visited[ids]
    newer, passed = (seen > belief.heard[ids]) & ~((seen <= visited) & (visited == since)), seen - since
    counted = newer & (belief.heard[ids] >= 0) & (passed > 0) & (queue < 60)
    expected = arrivals.rate[ids] * np.maximum(passed, 0)
    counted &= ~((visited == since) & (queue - base > expected + 4 * np.sqrt(expected) + 2))
    arrived, watched, recent = arrivals.arrived.copy(), arrivals.watched.copy(), arrivals.recent.copy()
    came = np.maximum(queue - base, 0.0)[counted]
    arrived[ids[counted]] += came
    watched[ids[counted]] += passed[counted]
    recent[ids[counted]] = came / passed[counted]
    variance = np.maximum(expected + passed**2 * arrivals.rate[ids] / arrivals.watched[ids], 1.0)[counted]
    surprise = arrivals.state_dict()["surprise"] + ((came - expected[counted]) ** 2 / variance).sum()
    take_report(report(step), step, records, belief)
    np.testing.assert_array_equal(belief.base[ids], np.where(newer, queue, base))
    np.testing.assert_array_equal(belief.since[ids], np.where(newer, seen, since))
    np.testing.assert_array_equal(arrivals.arrived, arrived)
    np.testing.assert_array_equal(arrivals.rate, arrived / watched)
    np.testing.assert_array_equal(arrivals.recent, recent)
    assert arrivals.state_dict()["surprise"] == pytest.approx(surprise, rel=1e-12)


def test_the_records_count_what_came_between_two_beacons_without_a_visit() -> None:
    records = Records(WORLD)
    before = records.rates[0]
    one, four = np.array([0]), np.array([4])
    records.hear(one, np.array([0]), np.array([10.0]))
    records.hear(one, four, np.array([42.0]))
    assert records.rates[0] == pytest.approx((before * 2 + 32) / (2 + 4))
    for seen, queue in ((3, 50.0), (6, 30.0), (7, 60.0)):
        # An old beacon, less than before, and a full queue.
        known = records.rates[0]
        records.hear(one, np.array([seen]), np.array([queue]))
        assert records.rates[0] == known
    records.presume(0, "visit", 8)
    records.hear(one, np.array([8]), np.array([0.0]))
    records.hear(one, np.array([9]), np.array([5.0]))
    assert records.rates[0] == known


def test_queues_and_bursts_are_those_of_the_formula() -> None:
    belief, _ = flown(40)
    arrivals, step = belief.arrivals, 43
    assert arrivals.in_bursts

    def burst(at: IntArray) -> FloatArray:
        above = np.where(arrivals.recent_at >= 0, np.maximum(arrivals.recent - arrivals.rate, 0.0), 0.0)
        return np.asarray(above * GOES_ON ** (np.maximum(at - arrivals.recent_at, 0) + 1) / (1 - GOES_ON))

    every = np.full(10, step)
    came = arrivals.rate * np.maximum(step - belief.since, 0)
    came += burst(np.minimum(belief.since, step)) - burst(every)
    np.testing.assert_allclose(arrivals.burst(step), burst(every), rtol=1e-14)
    np.testing.assert_allclose(belief.queue(step), np.minimum(belief.base + came, 60.0), rtol=1e-14)
    some = np.array([7, 2])
    np.testing.assert_array_equal(belief.queue(step, some), belief.queue(step)[some])
    np.testing.assert_array_equal(arrivals.burst(step, some), arrivals.burst(step)[some])
    assert (arrivals.burst(1_000_000) == 0.0).all()


@pytest.mark.parametrize("seed", range(40))
def test_links_by_formula_are_those_of_the_channel(seed: int) -> None:
    random = np.random.default_rng(seed)
    ranges = {
        "altitude_m": (10, 300),
        "transmit_power_w": (1e-3, 1),
        "path_loss_limit_db": (80, 140),
        "spectral_cap": (0.5, 12),
        "los_excess_db": (0, 5),
        # A loss that falls with the distance, too.
        "nlos_excess_db": (0, 40) if seed % 4 else (0, 0.1),
        "link_share": (0.1, 1),
        "radio_radius_m": (50, 600),
        # In many steps of rates, most rings differ.
        "packet_bits": (1e3, 1e5),
    }
    world = Scenario.model_validate({name: float(random.uniform(*bounds)) for name, bounds in ranges.items()})
    distance = np.append(random.uniform(0, 700, (15, 400)), np.full((15, 1), world.radio_radius_m), axis=1)
    ours, links = ExpectedLinks.by_formula(distance, world), Links.at(distance, world)
    np.testing.assert_array_equal(ours.packets, links.packets)
    np.testing.assert_array_equal(ours.hold, links.hold)


def test_a_transfer_is_the_channels() -> None:
    channel = FleetBelief(SCENARIOS["paper"]).channel
    for loss_db in (80.0, 106.0, 109.0, 111.0):
        link = Links(np.array(100.0), np.array(loss_db), SCENARIOS["paper"])
        packet_j, packets = channel.transfer(loss_db)
        world = link.scenario
        assert packet_j == pytest.approx(world.transmit_power_w * world.packet_bits / float(link.rate_bps), rel=1e-12)
        assert packets == int(link.packets)


def test_without_numba_the_belief_is_the_same() -> None:
    found = [
        json.loads(subprocess.run([sys.executable, "-c", HEARD, *missing], check=True, capture_output=True).stdout)
        for missing in ([], ["missing"])
    ]
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_a_sensor_that_there_is_not_is_an_error_and_so_are_columns_of_other_lengths() -> None:
    belief, records, one, unknown = FleetBelief(WORLD), Records(WORLD), np.ones(1), np.array([10])
    belief.locate(0, 3, (500.0, 450.0))
    calls: list[Callable[[], object]] = [
        lambda: belief.hear(unknown, np.ones((1, 2)), np.array([3]), one, one),
        lambda: belief.measure(0, unknown, one),
        lambda: belief.queue(3, unknown),
        lambda: belief.arrivals.coming(3, 8.0, unknown),
        lambda: records.hear(unknown, np.array([3]), one),
    ]
    for call in calls:
        with pytest.raises(IndexError, match="10"):
            call()
    three = np.arange(3)
    with pytest.raises(ValueError, match="3 sensors with 1 beacons, 1 queues, 1 batteries"):
        belief.hear(three, np.ones((3, 2)), np.array([3]), one, one)
    assert (belief.heard == -1).all()
