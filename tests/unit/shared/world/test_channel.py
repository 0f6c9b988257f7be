"""The channel against values computed by hand and against its own limits."""

from __future__ import annotations

import numpy as np
import pytest

from shared.world.channel import Links, channel_gain_db, link_holds, packets_per_step, path_loss_db, rate_bps
from shared.world.scenario import SCENARIOS, Scenario

PAPER = SCENARIOS["paper"]


@pytest.mark.parametrize(("distance", "loss"), [(0, 79.5), (100, 82.7), (200, 100.4), (360, 109.7)])
def test_path_loss_at_known_distances(distance: float, loss: float) -> None:
    assert float(path_loss_db(distance, PAPER)) == pytest.approx(loss, abs=0.1)


def test_right_below_the_uav_only_free_space_and_los_excess_remain() -> None:
    free_space = 20 * np.log10(4 * np.pi * 100.0 * 2e9 / 299_792_458)
    assert float(path_loss_db(0.0, PAPER)) == pytest.approx(free_space + 1.0, abs=1e-3)


def test_far_away_the_excess_is_that_of_a_blocked_path() -> None:
    free_space = 20 * np.log10(4 * np.pi * np.hypot(1e5, 100.0) * 2e9 / 299_792_458)
    assert float(path_loss_db(1e5, PAPER)) == pytest.approx(free_space + 20.0, abs=0.1)


def test_path_loss_grows_with_distance_and_keeps_the_shape() -> None:
    distance = np.linspace(0.0, 1000.0, 202).reshape(2, 101)
    loss = path_loss_db(distance, PAPER)
    assert loss.shape == distance.shape
    assert np.all(np.diff(loss.ravel()) > 0)
    np.testing.assert_array_equal(channel_gain_db(distance, PAPER), -loss)


def test_packets_a_step_near_and_at_the_radio_radius() -> None:
    assert packets_per_step([0.0, 100.0, 360.0], PAPER).tolist() == [60, 60, 51]


def test_link_fails_past_the_radius_and_past_the_threshold() -> None:
    assert link_holds([360.0, 360.1], PAPER).tolist() == [True, False]
    wide = PAPER.model_copy(update={"radio_radius_m": 1000.0})
    assert link_holds([360.0, 400.0], wide).tolist() == [True, False]
    assert packets_per_step([360.0, 400.0], wide).tolist() == [51, 0]


def test_link_fails_at_the_threshold_itself() -> None:
    at = float(path_loss_db(200.0, PAPER))
    assert not link_holds(200.0, PAPER.model_copy(update={"path_loss_limit_db": at}))
    assert link_holds(200.0, PAPER.model_copy(update={"path_loss_limit_db": at + 1e-6}))


def test_rate_is_shannons_below_the_cap_and_scales_with_the_share() -> None:
    snr_db = 20.0 - float(path_loss_db(360.0, PAPER)) - (-174.0 + 60.0 + 9.0)
    assert float(rate_bps(360.0, PAPER)) == pytest.approx(1e6 * np.log2(1 + 10 ** (snr_db / 10)))
    assert float(rate_bps(0.0, PAPER)) == pytest.approx(6e6)
    assert float(rate_bps(0.0, SCENARIOS["stress"])) == pytest.approx(0.35 * 6e6)
    assert packets_per_step(0.0, SCENARIOS["stress"]) == 21


def test_packets_are_whole() -> None:
    # 6 Mbit/s x 10 s / 7 Mbit = 8.57
    assert packets_per_step(0.0, Scenario(packet_bits=7e6)) == 8


def test_an_excess_loss_adds_to_the_mean() -> None:
    distance = np.array([0.0, 150.0, 300.0])
    links, mean = Links.at(distance, PAPER, [3.0, 0.0, -2.0]), Links.at(distance, PAPER)
    np.testing.assert_array_equal(links.loss_db, mean.loss_db + [3.0, 0.0, -2.0])
    assert not np.any(Links.at(distance, PAPER, 60.0).hold)
    assert links.packets.all()
    assert not Links.at(distance, PAPER, 60.0).packets.any()


def test_distances_and_excess_are_broadcast() -> None:
    excess = np.array([[0.0], [40.0]])
    links = Links.at([100.0, 200.0, 300.0], PAPER, excess)
    assert links.distance_m.shape == links.packets.shape == (2, 3)
    assert links.packets[0].all() and not links.packets[1, 1:].any()
    assert Links.at(100.0, PAPER, excess).packets.shape == (2, 1)
