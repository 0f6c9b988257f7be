"""The true channel of a world: what its links lose beyond the mean path loss, and the radios that die."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.channel import FloatArray, IntArray, Links
from shared.scenario import Scenario
from simulator.world.sensors import Streams

# Cosines in the sum of a sensor's shadowing. The realised correlation is then within some 0.1 of the exponential.
_COSINES = 128
# The wire's bounds of a channel gain, with the sign of a loss.
LOSS_BOUNDS_DB = (0.0, 400.0)


@dataclass(frozen=True, eq=False)
class TrueChannel:
    """The links of one world, or of B worlds of one scenario, as they are and no edge is told.

    *Instant* n is the moment after n steps of flight, 0..T: step t flies, and its transmissions and the beacons after
    it happen at instant t + 1.

    Attributes:
        scenario: of the world.
        own_db: shape ``(J,)`` or ``(B, 1, J)``, each sensor's own excess loss.
        frequencies: shape ``(2, M)`` or ``(B, 2, M)``, radians a metre, of the shadowing along the way.
        mixture: shape ``(2 M, J)`` or ``(B, 2 M, J)``, dB, the weights of their cosines and sines for each sensor.
        dies_at: shape ``(J,)`` or ``(B, 1, J)``, the first instant of a sensor's dead radio; T + 1 for never.
    """

    scenario: Scenario
    own_db: FloatArray
    frequencies: FloatArray
    mixture: FloatArray
    dies_at: IntArray

    @classmethod
    def draw(cls, scenario: Scenario, streams: Streams) -> Self:
        """One world's channel.

        The shadowing along the way is ``sigma sqrt(2 / M) sum_m cos(k_m . x + phi_mj)`` at the UAV's place x, with
        phases uniform over a turn. For the correlation ``exp(-r / d)`` of two places r metres apart, the frequencies k
        have the exponential's spectral measure in the plane, the bivariate Cauchy distribution of scale 1/d: a normal
        pair over the absolute value of another normal number (Rahimi and Recht, 2007).
        """
        count, sigma = scenario.sensors, scenario.route_shadowing_db
        own = np.round(scenario.shadowing_db * streams.shadowing.standard_normal(count), 6)
        cosines = _COSINES if sigma else 0
        pairs = streams.route_shadowing.standard_normal((2, cosines))
        scale = scenario.decorrelation_m * np.abs(streams.route_shadowing.standard_normal(cosines))
        phases = streams.route_shadowing.uniform(0.0, 2.0 * np.pi, (cosines, count))
        mixture = sigma * np.sqrt(2.0 / _COSINES) * np.concatenate((np.cos(phases), -np.sin(phases)))
        return cls(scenario, own, pairs / scale, mixture, _deaths(scenario, streams.radios))

    @classmethod
    def stack(cls, channels: Sequence[TrueChannel]) -> Self:
        """The channels of B worlds of one scenario as one."""
        return cls(
            channels[0].scenario,
            np.stack([one.own_db for one in channels])[:, None],
            np.stack([one.frequencies for one in channels]),
            np.stack([one.mixture for one in channels]),
            np.stack([one.dies_at for one in channels])[:, None],
        )

    @cached_property
    def mean_only(self) -> bool:
        """Whether every link has the mean path loss."""
        return not (self.scenario.shadowing_db or self.scenario.route_shadowing_db)

    def excess_db(self, position: FloatArray) -> FloatArray:
        """The excess loss from UAVs at positions ``(..., I, 2)``, metres, to every sensor, ``(..., I, J)``, dB.

        Rounded to a millionth, so that the same sum in another order gives the same link.
        """
        if not self.scenario.route_shadowing_db:
            return np.broadcast_to(self.own_db, (*position.shape[:-1], self.scenario.sensors))
        angle = position @ self.frequencies
        waves = np.concatenate((np.cos(angle), np.sin(angle)), axis=-1)
        return np.round(self.own_db + waves @ self.mixture, 6)

    def links(self, distance_m: FloatArray, excess_db: FloatArray) -> Links:
        """The links at horizontal distances, metres, with these excess losses, dB, both of one shape."""
        if self.mean_only:
            return Links.at(distance_m, self.scenario)
        links = Links.at(distance_m, self.scenario, excess_db)
        return replace(links, loss_db=np.clip(links.loss_db, *LOSS_BOUNDS_DB))

    def working(self, instant: int) -> NDArray[np.bool_]:
        """Whether each sensor's radio can transmit at that instant, shaped as ``dies_at``."""
        return np.asarray(instant < self.dies_at)


def _deaths(scenario: Scenario, rng: np.random.Generator) -> IntArray:
    dies_at = np.full(scenario.sensors, scenario.steps + 1)
    dead = rng.permutation(scenario.sensors)[: scenario.dead_radios]
    dies_at[dead] = rng.integers(1, scenario.steps, len(dead), endpoint=True)
    return dies_at
