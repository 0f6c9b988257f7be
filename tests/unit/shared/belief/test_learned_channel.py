"""The learned channel: which links are expected, which radios fail, and what rate is really seen."""

from __future__ import annotations

import numpy as np
import pytest

from shared.belief.learned_channel import ExpectedLinks, LearnedChannel, RadioFailures
from shared.features.augmented_state import Reach
from shared.world.channel import link_holds, packets_per_step, path_loss_db
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]
DISTANCES = np.array([[0.0, 120.0, 250.0, 359.0, 361.0]])
HERE = np.zeros((1, 2))
ALL = np.arange(5)


def channel(*excess: float, times: int = 1) -> LearnedChannel:
    """A channel of five sensors that measured these excess losses, dB, of the first of them."""
    learned = LearnedChannel(PAPER.model_copy(update={"sensors": 5}))
    distance = DISTANCES[0, : len(excess)]
    for at in range(times):
        learned.measure(ALL[: len(excess)], HERE[0] + 30.0 * at, distance, -path_loss_db(distance, PAPER) - excess)
    return learned


def test_without_a_sign_of_another_world_the_formula_counts_to_the_bit() -> None:
    learned = channel(0.0, 0.0, 0.0)
    links = learned.links(HERE, DISTANCES)
    assert learned.by_formula
    np.testing.assert_array_equal(links.packets, packets_per_step(DISTANCES, PAPER))
    np.testing.assert_array_equal(links.hold, link_holds(DISTANCES, PAPER))
    expected = Reach.of(links, np.full(5, 30.0), np.full(5, 0.5)).packets
    np.testing.assert_array_equal(expected, np.minimum(30.0, packets_per_step(DISTANCES, PAPER)))


def test_a_link_that_lost_more_than_the_threshold_allows_is_not_expected_again() -> None:
    links = channel(0.0, 25.0, 9.0, 0.1, times=3).links(HERE, DISTANCES)
    assert links.hold[0, 0] > 0.95
    assert links.hold[0, 2] < 0.1
    assert links.likely[0, 2] == 0 < links.likely[0, 1]
    assert Reach.of(links, np.full(5, 60.0), np.full(5, 0.5)).packets[0, 2] < 10


def test_a_better_link_than_the_formulas_never_reaches_past_the_radio_radius() -> None:
    links = channel(-20.0, -20.0, -20.0, -20.0, times=3).links(HERE, DISTANCES)
    assert links.hold[0, 3] > 0.9
    assert links.hold[0, 4] < 1e-9
    assert links.packets[0, 4] == 0


def test_links_of_some_sensors_are_those_of_all() -> None:
    learned = channel(4.0, -3.0, 8.0, 1.0, times=4)
    learned.failures.settle(2, failed=True)
    every, some = learned.links(HERE, DISTANCES), learned.links(HERE, DISTANCES[:, [3, 2]], np.array([3, 2]))
    np.testing.assert_allclose(some.hold, every.hold[:, [3, 2]])
    np.testing.assert_array_equal(some.packets, every.packets[:, [3, 2]])


def test_the_expected_gain_is_the_formulas_less_the_excess() -> None:
    learned = channel(5.0, 5.0, 5.0, 5.0, times=3)
    expected = -path_loss_db(DISTANCES[0], PAPER) - 5.0
    np.testing.assert_allclose(learned.gain_db(HERE[0], DISTANCES[0], ALL), expected, atol=2.0)


def test_two_failures_over_good_links_give_a_radio_up_and_time_gives_it_another_try() -> None:
    failures = RadioFailures(3)
    assert failures.alive().tolist() == [1.0] * 3
    failures.settle(1, failed=True)
    assert failures.dead == []
    failures.settle(1, failed=True)
    assert failures.dead == [1]
    assert failures.alive()[1] < 0.25
    failures.advance(100)
    assert failures.dead == []
    failures.advance(200)
    assert failures.none


def test_one_transmission_that_succeeds_shows_that_the_radio_works() -> None:
    failures = RadioFailures(3)
    for failed in (True, True, True, False):
        failures.settle(1, failed)
    assert failures.alive()[1] > 0.5


def test_a_failure_within_half_a_decibel_of_the_threshold_says_nothing_of_the_radio() -> None:
    learned = channel()
    assert not learned.transmitted(1, True, PAPER.path_loss_limit_db - 0.5)
    assert learned.failures.none
    assert learned.transmitted(1, True, PAPER.path_loss_limit_db - 0.6)
    assert not learned.failures.none


def test_forged_failures_are_forgotten_however_many_they_are() -> None:
    failures = RadioFailures(3)
    for _ in range(10_000):
        failures.settle(0, failed=True)
    failures.advance(100)
    assert failures.alive()[0] > 0.5


def test_a_dead_radio_is_no_link() -> None:
    learned = channel(0.0, 0.0)
    for _ in range(3):
        learned.failures.settle(1, failed=True)
    links = learned.links(HERE, DISTANCES)
    assert links.likely[0].tolist()[:2] == [60, 0]


def test_half_the_packets_that_a_link_should_move_are_half_the_rate() -> None:
    learned = channel(0.0, 0.0)
    learned.moved(59.0, before=60.0, link=60, slack=8.0)
    assert learned.share == 1.0
    for _ in range(6):
        learned.moved(30.0, before=60.0, link=60, slack=8.0)
    assert learned.share == pytest.approx(0.5, abs=0.1)
    assert 25 <= learned.links(HERE, DISTANCES).likely[0, 0] <= 35
    # Emptied queues tell no more than that the rate was enough for them.
    for _ in range(8):
        learned.moved(20.0, before=20.0, link=60, slack=8.0)
    assert learned.share == pytest.approx(0.5, abs=0.1)
    for _ in range(8):
        learned.moved(60.0, before=60.0, link=60, slack=8.0)
    assert learned.share == 1.0


def test_a_restored_channel_expects_the_same_to_the_bit() -> None:
    learned, again = channel(4.0, -3.0, 8.0, times=3), channel()
    learned.failures.settle(0, failed=True)
    learned.moved(30.0, 60.0, 60, 8.0)
    again.load_state_dict(learned.state_dict())
    for name in ("packets", "hold"):
        ours, theirs = (getattr(one.links(HERE, DISTANCES), name) for one in (learned, again))
        np.testing.assert_array_equal(ours, theirs)


def test_expected_links_by_the_formula_are_certain() -> None:
    links = ExpectedLinks.by_formula(DISTANCES, PAPER)
    assert set(links.hold.ravel().tolist()) == {0.0, 1.0}
    np.testing.assert_array_equal(links.packets, packets_per_step(DISTANCES, PAPER))
    np.testing.assert_array_equal(links.likely, links.packets)


def test_a_radio_counts_as_dead_for_at_most_81_steps_after_the_last_forged_failure() -> None:
    failures = RadioFailures(3)
    for _ in range(10_000):
        failures.settle(0, failed=True)
    failures.advance(79)
    assert failures.dead == [0]
    failures.advance(81)
    assert failures.dead == []
