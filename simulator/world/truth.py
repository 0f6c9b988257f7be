"""The differences of one world, or a batch of worlds, from an edge's planning model; the wind is one of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray, Links, path_loss_db
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory, trajectories
from simulator.world.gain_trace import GainTrace
from simulator.world.sensors import StepNoise, Streams

# Cosines in the sum of a sensor's shadowing.
_COSINES = 128
# The wire's bounds of a channel gain, with the sign of a loss.
LOSS_BOUNDS_DB = (0.0, 400.0)
# Below this power a fade counts as so deep, 100 dB.
_DEEPEST_FADE = 1e-10
# Losses are rounded to this many digits: then the same sum in another order, as in a batch, gives the same link.
_DIGITS = 6
# Half of the chord that gives the direction of the way, metres.
_HALF_CHORD_M = 0.5
# The largest error of a reported position on each axis, in standard deviations.
LARGEST_ERROR = 5.0


@dataclass(frozen=True, eq=False)
class Faults:
    """The faults of one world, or of B worlds of one scenario.

    *Instant* n is the moment after n steps of flight, 0..T: step t flies, and its transmissions and the beacons after
    it happen at instant t + 1.

    Attributes:
        scenario: of the world.
        dies_at: shape ``(J,)`` or ``(B, J)``, the first instant of a sensor's dead radio; T + 1 for never.
        departs_at: shape ``(I,)`` or ``(B, I)``, the instant at which a UAV leaves: it flies that many steps; T + 1
            for never.
        drops_at: shape ``()`` or ``(B,)``, the first instant with the lower link share.
    """

    scenario: Scenario
    dies_at: IntArray
    departs_at: IntArray
    drops_at: IntArray

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """One world's faults; a mission of a single step has no departures."""
        steps = scenario.steps
        dies_at, departs_at = np.full(scenario.sensors, steps + 1), np.full(scenario.uavs, steps + 1)
        dead = rng.permutation(scenario.sensors)[: scenario.dead_radios]
        dies_at[dead] = rng.integers(1, steps, len(dead), endpoint=True)
        gone = rng.permutation(scenario.uavs)[: scenario.departures if steps > 1 else 0]
        departs_at[gone] = rng.integers(1, max(steps - 1, 1), len(gone), endpoint=True)
        drops_at = rng.integers(steps // 4 + 1, 3 * steps // 4 + 1, endpoint=True)
        return cls(scenario, dies_at, departs_at, np.asarray(drops_at))

    def present(self, instant: int) -> NDArray[np.bool_]:
        """Whether each UAV is still in the mission at that instant, ``(I,)`` or ``(B, I)``."""
        return np.asarray(instant < self.departs_at)

    def share(self, instant: int) -> FloatArray | float:
        """Each sensor's share of a link's rate at that instant, ``(1, J)`` or ``(B, 1, J)``; 0 for a dead radio."""
        world = self.scenario
        if not (world.dead_radios or world.link_share_drop):
            return 1.0
        left = np.where(instant < self.drops_at, 1.0, 1.0 - world.link_share_drop)
        return np.asarray((left[..., None] * (instant < self.dies_at))[..., None, :])


def mean_only(scenario: Scenario, trace: GainTrace | None = None) -> bool:
    """Whether every link of such a world has the mean path loss."""
    return trace is None and not (
        scenario.shadowing_db or scenario.route_shadowing_db or scenario.rician_k_db is not None
    )


@dataclass(frozen=True, eq=False)
class TrueChannel:
    """The links of one world, or of B worlds of one scenario, as they are and no edge is told.

    An *instant* is that of :class:`simulator.world.truth.Faults`.

    Attributes:
        scenario: of the world.
        own_db: shape ``(J,)`` or ``(B, J)``, each sensor's own excess loss.
        frequencies: shape ``(2, M)`` or ``(B, 2, M)``, radians a metre, of the shadowing along the way.
        mixture: shape ``(2 M, J)`` or ``(B, 2 M, J)``, dB, the weights of their cosines and sines for each sensor.
        fading: the normal numbers of small-scale fading.
        faults: of the radios and the links' share.
        paths: one trajectory a UAV.
        trace: measured excess losses, added to the others.
    """

    scenario: Scenario
    own_db: FloatArray
    frequencies: FloatArray
    mixture: FloatArray
    fading: StepNoise
    faults: Faults
    paths: tuple[Trajectory, ...]
    trace: GainTrace | None = None

    @classmethod
    def draw(cls, scenario: Scenario, streams: Streams, faults: Faults, trace: GainTrace | None = None) -> Self:
        """One world's channel.

        The shadowing along the way is ``sigma sqrt(2 / M) sum_m cos(k_m . x + phi_mj)`` at the UAV's place x, with
        phases uniform over a turn. For the correlation ``exp(-r / d)`` of two places r metres apart, the frequencies k
        have the exponential's spectral measure in the plane, the bivariate Cauchy distribution of scale 1/d: a normal
        pair over the absolute value of another normal number (Rahimi and Recht, 2007).
        """
        count, sigma = scenario.sensors, scenario.route_shadowing_db
        own = np.round(scenario.shadowing_db * streams.shadowing.standard_normal(count), _DIGITS)
        cosines = _COSINES if sigma else 0
        rng = streams.route_shadowing
        pairs = rng.standard_normal((2, cosines))
        scale = scenario.decorrelation_m * np.abs(rng.standard_normal(cosines))
        phases = rng.uniform(0.0, 2.0 * np.pi, (cosines, count))
        mixture = sigma * np.sqrt(2.0 / _COSINES) * np.concatenate((np.cos(phases), -np.sin(phases)))
        fading = StepNoise.draw(streams.fading)
        return cls(scenario, own, pairs / scale, mixture, fading, faults, trajectories(scenario), trace)

    @property
    def changes(self) -> bool:
        """Whether the links of one place differ between instants."""
        world = self.scenario
        return world.rician_k_db is not None or bool(world.dead_radios or world.link_share_drop)

    def links(self, distance_m: FloatArray, position: FloatArray, progress_m: FloatArray, instant: int) -> Links:
        """The links of all UAVs to all sensors at an instant, ``(..., I, J)``.

        Past the radio radius the loss counts as infinite.

        Args:
            distance_m: horizontal, ``(..., I, J)``.
            position: of the UAVs, metres, ``(..., I, 2)``.
            progress_m: of the UAVs, ``(..., I)``.
            instant: of the transmissions, and of the beacons that measure these links.
        """
        # The path loss is the costliest number of a step. Of many links, indices are several times as fast as a mask.
        near = np.flatnonzero(distance_m <= self.scenario.radio_radius_m)
        modelled = mean_only(self.scenario, self.trace)
        excess = 0.0 if modelled else self.excess_db(position, progress_m, instant).take(near)
        loss = np.full(distance_m.shape, np.inf)
        loss.put(near, self.at(distance_m.take(near), excess, 1.0).loss_db)
        return Links(distance_m, loss, self.scenario, self.share(distance_m, instant))

    def at(self, distance_m: FloatArray, excess_db: FloatArray | float, share: FloatArray | float) -> Links:
        """The links at these distances, metres, with these excess losses, dB, and shares of the rate."""
        loss = path_loss_db(distance_m, self.scenario)
        if not mean_only(self.scenario, self.trace):
            loss = np.clip(loss + excess_db, *LOSS_BOUNDS_DB)
        return Links(distance_m, loss, self.scenario, share)

    def excess_db(self, position: FloatArray, progress_m: FloatArray, instant: int) -> FloatArray:
        """The excess losses at an instant; shapes as of :meth:`links`."""
        return self.place_db(position, progress_m) + self.fade_db(instant)

    def place_db(self, position: FloatArray, progress_m: FloatArray) -> FloatArray:
        """The part of the excess losses that depends on the UAVs' places alone; shapes as of :meth:`links`."""
        count = self.scenario.sensors
        excess = np.broadcast_to(self.own_db[..., None, :], (*position.shape[:-1], count))
        if self.scenario.route_shadowing_db:
            angle = position @ self.frequencies
            waves = np.concatenate((np.cos(angle), np.sin(angle)), axis=-1)
            excess = excess + np.round(waves @ self.mixture, _DIGITS)
        if self.trace is not None:
            excess = excess + np.round(self.trace.excess_db(progress_m, self.paths, count), _DIGITS)
        return excess

    def fade_db(self, instant: int) -> FloatArray:
        """The loss by small-scale fading at an instant, ``(I, J)`` or ``(B, I, J)``, dB; without fading ``()``.

        The power is ``|h|^2`` with ``h = sqrt(K / (K + 1)) + n``, n complex normal of variance ``1 / (K + 1)``.
        """
        if self.scenario.rician_k_db is None:
            return np.zeros(())
        k = 10.0 ** (self.scenario.rician_k_db / 10.0)
        scattered = self.fading.normal(instant, (len(self.paths), self.scenario.sensors, 2)) * np.sqrt(0.5 / (k + 1.0))
        power = (np.sqrt(k / (k + 1.0)) + scattered[..., 0]) ** 2 + scattered[..., 1] ** 2
        return np.asarray(np.round(-10.0 * np.log10(np.maximum(power, _DEEPEST_FADE)), _DIGITS))

    def share(self, distance_m: FloatArray, instant: int) -> FloatArray | float:
        """The shares of the links' rate at an instant, shaped as the distances, or one for all."""
        share = self.faults.share(instant)
        return share if isinstance(share, float) else np.broadcast_to(share, distance_m.shape)


@dataclass(frozen=True, eq=False)
class Wind:
    """The wind of one world, or of B worlds of one scenario.

    Over a step a UAV of velocity v covers ``v step_s min(2, max(0, 1 + w / max_velocity))``, where w is the wind along
    its way: the mean wind's component in the middle of the way that it would fly in still air, and its gust of the
    step.
    """

    scenario: Scenario
    gusts: StepNoise

    @classmethod
    def draw(cls, scenario: Scenario, rng: np.random.Generator) -> Self:
        """One world's."""
        return cls(scenario, StepNoise.draw(rng))

    @property
    def blows(self) -> bool:
        """Whether there is any wind."""
        return bool(self.scenario.wind_mps or self.scenario.gust_mps)

    def flown_m(
        self, velocity: IntArray, progress_m: FloatArray, paths: Sequence[Trajectory], instant: int
    ) -> FloatArray:
        """The metres that UAVs ``(..., I)`` at a progress cover in the step that begins at an instant."""
        still = np.asarray(velocity * self.scenario.step_s, dtype=np.float64)
        if not self.blows:
            return still
        along = self.along_mps(progress_m + still / 2, paths) + self.gust_mps(instant, len(paths))
        return np.asarray(still * self.stretch(along))

    def stretch(self, along_mps: FloatArray) -> FloatArray:
        """The metres flown in a wind along the way per metre in still air, 0..2."""
        return np.asarray(np.clip(1.0 + along_mps / self.scenario.max_velocity, 0.0, 2.0))

    def gust_mps(self, instant: int, uavs: int) -> FloatArray:
        """Each UAV's gust along its way in the step that begins at an instant, ``(I,)`` or ``(B, I)``, m/s."""
        if not self.scenario.gust_mps:
            return np.zeros(uavs)
        return self.scenario.gust_mps * self.gusts.normal(instant, (uavs,))

    def along_mps(self, progress_m: FloatArray, paths: Sequence[Trajectory]) -> FloatArray:
        """The mean wind's component along each UAV's way at a progress ``(..., I)``, m/s."""
        towards = math.radians(self.scenario.wind_from_deg + 180.0)
        east, north = self.scenario.wind_mps * math.sin(towards), self.scenario.wind_mps * math.cos(towards)
        along = np.empty(progress_m.shape)
        for uav, path in enumerate(paths):
            middle = progress_m[..., uav]
            chord = path.at(middle + _HALF_CHORD_M) - path.at(middle - _HALF_CHORD_M)
            # Where a trajectory turns back on itself it has no direction.
            length = np.maximum(np.hypot(chord[..., 0], chord[..., 1]), 1e-9)
            along[..., uav] = (east * chord[..., 0] + north * chord[..., 1]) / length
        return along


@dataclass(frozen=True, eq=False)
class Truth:
    """Channel, wind, faults and position errors of one world, or of B worlds of one scenario."""

    channel: TrueChannel
    wind: Wind
    faults: Faults
    position_noise: StepNoise

    @classmethod
    def draw(cls, scenario: Scenario, streams: Streams, gains: GainTrace | None = None) -> Self:
        """One world's; ``gains`` adds measured excess losses."""
        faults = Faults.draw(scenario, streams.faults)
        channel = TrueChannel.draw(scenario, streams, faults, gains)
        return cls(channel, Wind.draw(scenario, streams.gusts), faults, StepNoise.draw(streams.position_noise))

    @property
    def differs(self) -> bool:
        """Whether links, wind or the fleet differ from what an edge plans with."""
        channel = self.channel
        modelled = mean_only(channel.scenario, channel.trace) and not channel.changes
        return not modelled or self.wind.blows or channel.scenario.departures > 0

    def reported(self, position: FloatArray, instant: int) -> FloatArray:
        """The positions that UAVs at ``(..., I, 2)`` report at an instant, metres."""
        deviation = self.channel.scenario.position_noise_m
        if not deviation:
            return position
        errors = self.position_noise.normal(instant, position.shape[-2:])
        return position + deviation * np.clip(errors, -LARGEST_ERROR, LARGEST_ERROR)
