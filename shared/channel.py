"""The air-to-ground channel: path loss, gain and rate (Al-Hourani et al., 2014, angles in degrees)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.scenario import Scenario

_SPEED_OF_LIGHT = 299_792_458.0

FloatArray = NDArray[np.float64]


def path_loss_db(distance_m: ArrayLike, scenario: Scenario) -> FloatArray:
    """Mean path loss at a horizontal distance, dB; same shape as the distance.

    ``FSPL(d3) + P_los eta_los + (1 - P_los) eta_nlos`` with the slant distance
    ``d3 = sqrt(d^2 + H^2)``, the elevation angle in degrees and
    ``P_los = 1 / (1 + a exp(-kappa (angle - a)))``. Finite at d = 0.
    """
    d = np.asarray(distance_m, dtype=np.float64)
    slant = np.hypot(d, scenario.altitude_m)
    angle = np.degrees(np.arctan2(scenario.altitude_m, d))
    free_space = 20.0 * np.log10(4.0 * np.pi * slant * scenario.carrier_mhz * 1e6 / _SPEED_OF_LIGHT)
    p_los = 1.0 / (1.0 + scenario.los_a * np.exp(-scenario.los_kappa * (angle - scenario.los_a)))
    return np.asarray(free_space + p_los * scenario.los_excess_db + (1.0 - p_los) * scenario.nlos_excess_db)


def channel_gain_db(distance_m: ArrayLike, scenario: Scenario) -> FloatArray:
    """Channel gain in dB: minus the path loss."""
    return -path_loss_db(distance_m, scenario)


def link_holds(distance_m: ArrayLike, scenario: Scenario) -> NDArray[np.bool_]:
    """Whether a transfer can succeed: within the radio radius and below the path-loss threshold."""
    d = np.asarray(distance_m, dtype=np.float64)
    return np.asarray((d <= scenario.radio_radius_m) & (path_loss_db(d, scenario) < scenario.path_loss_limit_db))


def rate_bps(distance_m: ArrayLike, scenario: Scenario) -> FloatArray:
    """Rate of a transfer, bit/s: Shannon's, capped at the modulation's, times the link's share.

    The threshold is not applied here; see :func:`link_holds`.
    """
    return _rate(path_loss_db(distance_m, scenario), scenario)


def packets_per_step(distance_m: ArrayLike, scenario: Scenario) -> NDArray[np.int64]:
    """Whole packets that one step can move at that distance; 0 where the link fails."""
    d = np.asarray(distance_m, dtype=np.float64)
    packets = np.zeros(d.shape, dtype=np.int64)
    # The path loss is what takes the time, and most of many sensors are out of every reach.
    near = d <= scenario.radio_radius_m
    loss = path_loss_db(d[near], scenario)
    moved = np.floor(_rate(loss, scenario) * scenario.step_s / scenario.packet_bits + 1e-9)
    packets[near] = np.where(loss < scenario.path_loss_limit_db, moved, 0.0)
    return packets


def _rate(loss_db: FloatArray, scenario: Scenario) -> FloatArray:
    power_dbm = 10.0 * np.log10(scenario.transmit_power_w * 1e3)
    noise_dbm = scenario.noise_dbm_hz + 10.0 * np.log10(scenario.bandwidth_hz) + scenario.noise_figure_db
    snr = 10.0 ** ((power_dbm - loss_db - noise_dbm) / 10.0)
    efficiency = np.minimum(np.log2(1.0 + snr), scenario.spectral_cap)
    return np.asarray(scenario.link_share * scenario.bandwidth_hz * efficiency)
