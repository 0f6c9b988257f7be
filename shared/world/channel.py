"""The air-to-ground channel: path loss, gain and rate (Al-Hourani et al., 2014, angles in degrees)."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.scenario import Scenario

_SPEED_OF_LIGHT = 299_792_458.0

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class LinkBudget(NamedTuple):
    """A scenario's numbers that its links depend on, under the same names, for compiled functions."""

    altitude_m: float
    radio_radius_m: float
    step_s: float
    transmit_power_w: float
    los_a: float
    los_kappa: float
    los_excess_db: float
    nlos_excess_db: float
    carrier_mhz: float
    path_loss_limit_db: float
    bandwidth_hz: float
    noise_dbm_hz: float
    noise_figure_db: float
    spectral_cap: float
    packet_bits: float
    link_share: float

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """The numbers of a scenario."""
        return cls(*(float(getattr(scenario, name)) for name in cls._fields))


def path_loss_db(distance_m: ArrayLike, scenario: Scenario) -> FloatArray:
    """Mean path loss at a horizontal distance, dB; same shape as the distance.

    ``FSPL(d3) + P_los eta_los + (1 - P_los) eta_nlos`` with the slant distance
    ``d3 = sqrt(d^2 + H^2)``, the elevation angle in degrees and
    ``P_los = 1 / (1 + a exp(-kappa (angle - a)))``. Finite at d = 0.
    """
    return np.asarray(mean_loss_db(np.asarray(distance_m, dtype=np.float64), scenario))


def mean_loss_db(d: Any, world: Scenario | LinkBudget) -> Any:
    """As :func:`path_loss_db`, of a float64 array, or of one number where it is part of a compiled function."""
    slant = np.hypot(d, world.altitude_m)
    angle = np.degrees(np.arctan2(world.altitude_m, d))
    free_space = 20.0 * np.log10(4.0 * np.pi * slant * world.carrier_mhz * 1e6 / _SPEED_OF_LIGHT)
    p_los = 1.0 / (1.0 + world.los_a * np.exp(-world.los_kappa * (angle - world.los_a)))
    return free_space + p_los * world.los_excess_db + (1.0 - p_los) * world.nlos_excess_db


def whole_rate_bps(loss_db: Any, world: Scenario | LinkBudget) -> Any:
    """The rate of links with all of the scenario's share, bit/s; arguments as of :func:`mean_loss_db`."""
    power_dbm = 10.0 * np.log10(world.transmit_power_w * 1e3)
    noise_dbm = world.noise_dbm_hz + 10.0 * np.log10(world.bandwidth_hz) + world.noise_figure_db
    snr = 10.0 ** ((power_dbm - loss_db - noise_dbm) / 10.0)
    efficiency = np.minimum(np.log2(1.0 + snr), world.spectral_cap)
    return world.link_share * world.bandwidth_hz * efficiency


@dataclass(frozen=True)
class Links:
    """Transfers at horizontal distances ``(...)``, metres, with the path loss ``(...)``, dB, computed once.

    ``share``, ``(...)`` or one number, is a link's own share of the rate, besides the scenario's ``link_share``; a link
    without any share moves no packets.
    """

    distance_m: FloatArray
    loss_db: FloatArray
    scenario: Scenario
    share: FloatArray | float = 1.0

    @classmethod
    def at(cls, distance_m: ArrayLike, scenario: Scenario, excess_db: ArrayLike = 0.0) -> Self:
        """The links at these distances.

        ``excess_db`` is the loss above the mean path loss, dB; distances and excess are broadcast together.
        """
        d = np.asarray(distance_m, dtype=np.float64)
        loss = np.asarray(path_loss_db(d, scenario) + np.asarray(excess_db, dtype=np.float64))
        return cls(d if d.shape == loss.shape else np.broadcast_to(d, loss.shape), loss, scenario)

    def __getitem__(self, which: Any) -> Self:
        """The links at an index, which may be any index of an array."""
        share = self.share[which] if isinstance(self.share, np.ndarray) else self.share
        return replace(self, distance_m=self.distance_m[which], loss_db=self.loss_db[which], share=share)

    @property
    def gain_db(self) -> FloatArray:
        """Channel gain, dB: minus the path loss."""
        return -self.loss_db

    @cached_property
    def hold(self) -> NDArray[np.bool_]:
        """As :func:`link_holds`."""
        near = self.distance_m <= self.scenario.radio_radius_m
        return np.asarray(near & (self.loss_db < self.scenario.path_loss_limit_db) & (self.share > 0))

    @cached_property
    def rate_bps(self) -> FloatArray:
        """As :func:`rate_bps`."""
        return np.asarray(whole_rate_bps(self.loss_db, self.scenario) * self.share)

    @property
    def packets(self) -> NDArray[np.int64]:
        """As :func:`packets_per_step`."""
        moved = np.floor(self.rate_bps * self.scenario.step_s / self.scenario.packet_bits + 1e-9)
        return np.asarray(np.where(self.hold, moved, 0.0).astype(np.int64))


def channel_gain_db(distance_m: ArrayLike, scenario: Scenario) -> FloatArray:
    """Channel gain in dB: minus the path loss."""
    return Links.at(distance_m, scenario).gain_db


@lru_cache
def best_gain_db(scenario: Scenario) -> float:
    """Channel gain right above a sensor, dB."""
    return float(channel_gain_db(0.0, scenario))


def link_holds(distance_m: ArrayLike, scenario: Scenario) -> NDArray[np.bool_]:
    """Whether a transfer can succeed: within the radio radius and below the path-loss threshold."""
    return Links.at(distance_m, scenario).hold


def rate_bps(distance_m: ArrayLike, scenario: Scenario) -> FloatArray:
    """Rate of a transfer, bit/s: Shannon's, capped at the modulation's, times the link's share.

    The threshold is not applied here; see :func:`link_holds`.
    """
    return Links.at(distance_m, scenario).rate_bps


def packets_per_step(distance_m: ArrayLike, scenario: Scenario) -> NDArray[np.int64]:
    """Whole packets that one step can move at that distance; 0 if the link fails."""
    d = np.asarray(distance_m, dtype=np.float64)
    packets = np.zeros(d.shape, dtype=np.int64)
    # Most of many sensors are out of radio range, and the path loss takes most of the time.
    near = d <= scenario.radio_radius_m
    packets[near] = Links.at(d[near], scenario).packets
    return packets
