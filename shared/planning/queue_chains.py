"""The sensors' queues as Markov chains: the losses that a plan expects where links and arrivals are uncertain."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray

Floats = NDArray[np.float32]

# A queue has at most this many levels in addition to the empty one, fewer than annealing_arrays.py has room for; with a
# larger capacity a level is several packets.
_MOST_LEVELS = 30
# The levels are those of the queue's upper end: at least so many packets, and this factor times what arrives in the
# steps that count, so many standard deviations above the mean.
_LEAST_TOP, _SPARE, _DEVIATIONS = 60, 1.5, 4.0
# A negative binomial with this many successes is a Poisson distribution.
_POISSON = 1e9
# The places of a uniform distribution's quantiles, for a queue without a beacon.
_QUANTILES = np.linspace(-1.0, 1.0, 9)


@dataclass(frozen=True, eq=False)
class QueueChains:
    """The Markov chains of J sensors' queues over a horizon of H steps, on G + 1 levels up to W packets.

    The lowest level stands for all queues that no arrivals fill within the steps that count.

    Attributes:
        level: packets of a level.
        start: shape ``(J, G + 1)``, the probability of each level before the first step.
        arrive: shape ``(H, J, G + 1)``, the probabilities of a step's arrivals, in levels; the last one of G or more.
        lost: shape ``(H, J, G + 1)``, the packets that a step is expected to lose, by the level before its arrivals.
        after: shape ``(K, J, G + 1)``, those that are expected to be lost after the horizon, by the level then and by
            the stage.
    """

    level: float
    start: Floats
    arrive: Floats
    lost: Floats
    after: Floats


@dataclass(frozen=True)
class Arriving:
    """Arrivals at J sensors, packets: their mean and variance, shape ``(..., J)``."""

    mean: FloatArray
    variance: FloatArray


def queue_chains(
    base: FloatArray,
    base_variance: FloatArray,
    came: Arriving,
    coming: Arriving,
    later: Arriving,
    capacity: int,
    best_chance: FloatArray,
    weights: FloatArray,
) -> QueueChains:
    """The chains of queues whose arrivals are negative binomial (a Poisson's of an uncertain rate).

    Args:
        base: the last known packets, ``(J,)``.
        base_variance: their variance, ``(J,)``, of a uniform distribution.
        came: since then, ``(J,)``.
        coming: in each step of the horizon, ``(H, J)``.
        later: in all the steps after the horizon whose losses count too, by stage, ``(K, J)``, of which each includes
            those of the stage before.
        capacity: W, packets.
        best_chance: the share, ``(J,)``, of the losses beyond the first stage's that count.
        weights: the factor of each sensor's lost packets, ``(J,)``.
    """
    most = coming.mean.sum(axis=0) + later.mean[-1]
    most += _DEVIATIONS * np.sqrt(coming.variance.sum(axis=0) + later.variance[-1])
    low = base - capacity
    capacity = int(min(capacity, max(_LEAST_TOP, np.ceil(_SPARE * most.max(initial=0.0)))))
    low += capacity
    base, came = np.maximum(low, 0.0), Arriving(np.maximum(came.mean + np.minimum(low, 0.0), 0.0), came.variance)
    count = min(capacity, _MOST_LEVELS)
    level = capacity / count
    came_by, _ = _by_level(came, capacity, count)
    start = _after(_uniform(base / level, np.sqrt(3.0 * base_variance) / level, count), came_by)
    arrive, over = _by_level(coming, capacity, count)
    # Nobody visits after the horizon, so that all packets above the capacity are lost, in whichever order they come.
    _, after = _by_level(later, capacity, count)
    after = after[0] + best_chance[:, None] * (after - after[0])
    whole = (start, arrive, over * weights[:, None], after * weights[:, None])
    return QueueChains(level, *(array.astype(np.float32) for array in whole))


def _by_level(arriving: Arriving, capacity: int, count: int) -> tuple[FloatArray, FloatArray]:
    """The probabilities of arrivals in levels, the last of all that are more, and the packets lost ``(..., J, G + 1)``.

    What is lost is by the level before the arrivals.
    """
    level = capacity / count
    odds = _negative_binomial(arriving.mean, arriving.variance, capacity)
    if level != 1.0:
        # A number of packets between two levels counts as the nearer one the more, so that the mean stays.
        away = np.abs(np.arange(capacity + 1)[:, None] / level - np.arange(count + 1))
        odds = odds @ np.maximum(0.0, 1.0 - away)
    # E[(a - room)+] = E[a] - sum_{k < room} P(a > k)
    exceed = np.maximum(1.0 - np.cumsum(odds, axis=-1), 0.0)
    held = np.concatenate((np.zeros((*odds.shape[:-1], 1)), np.cumsum(exceed, axis=-1)[..., :-1]), axis=-1)
    lost = np.maximum(arriving.mean[..., None] - level * held[..., ::-1], 0.0)
    odds[..., -1] = np.maximum(1.0 - odds[..., :-1].sum(axis=-1), 0.0)
    return odds, lost


def _after(odds: FloatArray, arrive: FloatArray) -> FloatArray:
    """The odds of each level after arrivals, ``(J, G + 1)`` each; a full queue stays full."""
    levels = np.arange(odds.shape[1])
    more = levels - levels[:, None]
    after = (odds[:, None] @ np.where(more >= 0, arrive[:, np.maximum(more, 0)], 0.0))[:, 0]
    after[:, -1] = np.maximum(1.0 - after[:, :-1].sum(axis=1), 0.0)
    return after


def _negative_binomial(mean: FloatArray, variance: FloatArray, most: int) -> FloatArray:
    """The probabilities of 0..most, ``(..., most + 1)``; of a variance not above the mean a Poisson's."""
    size = np.square(mean) / np.maximum(variance - mean, 1e-12)
    size = np.clip(size, 1e-9, _POISSON)[..., None]
    mean = mean[..., None]
    k = np.arange(most)
    with np.errstate(divide="ignore"):
        ratio = np.log((k + size) / (k + 1) * (mean / (size + mean)))
    none = -size * np.log1p(mean / size)
    return np.asarray(np.exp(none + np.concatenate((np.zeros_like(none), np.cumsum(ratio, axis=-1)), axis=-1)))


def _uniform(middle: FloatArray, half: FloatArray, count: int) -> FloatArray:
    """The odds of each level, ``(J, G + 1)``, of a queue uniform around a middle ``(J,)``, in levels."""
    points = np.clip(middle[:, None] + half[:, None] * _QUANTILES, 0.0, count)
    away = np.abs(points[..., None] - np.arange(count + 1))
    return np.asarray(np.maximum(0.0, 1.0 - away).mean(axis=1))
