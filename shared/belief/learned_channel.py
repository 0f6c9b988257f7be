"""A fleet's learned channel: the formula, the radio map, failing radios, and the observed rate."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from shared.belief import link_expectations
from shared.belief.radio_map import RadioMap
from shared.world.channel import FloatArray, IntArray, LinkBudget, path_loss_db
from shared.world.scenario import Point, Scenario

# Rings around a UAV whose links by the formula are computed once. In the scenarios, all but nine have equal links.
_RINGS = 1024
# The least probability of working from which a link counts as one.
LIKELY = 0.5
# The rate share is the median of this many informative visits: with bursty arrivals, one visit proves nothing.
_SHARE_VISITS = 5
# A share above this is no loss, and the least that counts.
_WHOLE_SHARE, _LEAST_SHARE = 0.93, 0.05
# The prior probability that a radio is dead, and the odds of a failure over a good link if it is, and if it works.
_PRIOR = math.log(0.01 / 0.99)
_FAILED = math.log(0.99 / 0.05)
_SENT = math.log(0.01 / 0.95)
# The odds fall back to the prior by this much a step, so that a dead radio is tried again after some 60 steps.
_FORGET = 0.05
_MOST = 4.0
# A failure is attributed to the radio if the loss is at least this far below the threshold, dB.
GOOD_LINK_DB = 0.5


@dataclass(frozen=True)
class ExpectedLinks:
    """Transfers that are expected from a UAV's places to sensors; arrays ``(P, J)``.

    Attributes:
        distance: horizontal, metres.
        packets: that a step can move if the link holds; 0 if it is most unlikely to.
        hold: the probability that each link works, 0..1.
        margin: how many standard deviations the path loss lies below the threshold; None: the loss is certain.
    """

    distance: FloatArray
    packets: IntArray
    hold: FloatArray
    margin: FloatArray | None = None

    @classmethod
    def by_formula(cls, distance: FloatArray, scenario: Scenario) -> Self:
        """The links of the mean path loss at distances ``(P, n)``."""
        world = LinkBudget.of(scenario)
        packets, hold = np.empty(distance.shape, dtype=np.int64), np.empty(distance.shape)
        link_expectations.formula_transfers(world, *_rings(world), np.ascontiguousarray(distance), packets, hold)
        return cls(distance, packets, hold)

    @property
    def likely(self) -> IntArray:
        """``packets`` if the link is likely to hold, else 0."""
        return np.asarray(np.where(self.hold >= LIKELY, self.packets, 0))


@lru_cache(maxsize=64)
def _rings(world: LinkBudget) -> tuple[IntArray, FloatArray]:
    """What :func:`shared.belief.link_expectations.know_rings` writes, computed once for a scenario."""
    packets, hold = np.empty(_RINGS, dtype=np.int64), np.empty(_RINGS)
    link_expectations.know_rings(world, packets, hold)
    return packets, hold


class RadioFailures:
    """The log odds that each of J radios is dead, ``(J,)``, by Bayes' rule from the outcomes over good links."""

    def __init__(self, sensors: int) -> None:
        self._odds: FloatArray = np.full(sensors, _PRIOR)
        self.step = 0
        self.none = True

    def settle(self, sensor: int, failed: bool) -> None:
        """Learn from the outcome of a transmission over a working link."""
        if self.none and not failed:
            return
        self.none = False
        self._odds[sensor] = min(max(float(self._odds[sensor]) + (_FAILED if failed else _SENT), _PRIOR), _MOST)

    def advance(self, step: int) -> None:
        """Go to a later step: earlier evidence counts less."""
        if not self.none:
            self._odds = np.maximum(self._odds - _FORGET * (step - self.step), _PRIOR)
            self.none = bool((self._odds <= _PRIOR).all())
        self.step = step

    def alive(self, which: slice | IntArray = slice(None)) -> FloatArray:
        """The probability that each radio works, of all sensors or of those named; 1 for one that never failed."""
        odds = self._odds[which]
        return np.where(odds <= _PRIOR, 1.0, 1.0 / (1.0 + np.exp(odds)))

    @property
    def dead(self) -> list[int]:
        """The sensors whose radio is more likely dead than not."""
        return [int(sensor) for sensor in np.flatnonzero(self._odds > 0)]

    def state_dict(self) -> dict[str, Any]:
        """The odds, as a copy."""
        return {"odds": self._odds.copy(), "step": self.step, "none": self.none}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the odds."""
        self._odds, self.step, self.none = state["odds"], state["step"], state["none"]


class LearnedChannel:
    """One fleet's knowledge of its links.

    Attributes:
        radio_map: the excess loss over the formula.
        failures: the radios that fail over good links.
        share: the rate that transfers get, as a share of the formula's, 0.05..1: the median of the last visits.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario, self._budget = scenario, LinkBudget.of(scenario)
        self.radio_map = RadioMap(scenario.sensors)
        self.failures = RadioFailures(scenario.sensors)
        self._shares = [1.0] * _SHARE_VISITS
        self.share = 1.0

    @property
    def by_formula(self) -> bool:
        """Whether all observations agree with the formula."""
        return self.radio_map.exact and self.failures.none and self.share == 1.0

    def measure(self, ids: IntArray, place: ArrayLike, distance: FloatArray, gain_db: FloatArray) -> FloatArray:
        """Learn from the gains ``(n,)`` that a UAV at its place ``(2,)`` measured of sensors at distances ``(n,)``.

        Returns:
            their excess losses over the formula, dB.
        """
        excess_db = np.empty(len(ids))
        link_expectations.measured_excess(self._budget, np.array(distance), np.array(gain_db), excess_db)
        return self.radio_map.measure(ids, place, excess_db)

    def links(self, places: FloatArray, distance: FloatArray, ids: IntArray | None = None) -> ExpectedLinks:
        """The links from a UAV's places ``(P, 2)`` to sensors at distances ``(P, n)``, all or those named."""
        world = self._scenario
        if self.by_formula:
            return ExpectedLinks.by_formula(distance, world)
        near = (distance <= world.radio_radius_m).any(axis=0)
        which = np.flatnonzero(near) if ids is None else np.asarray(ids)[near]
        packets, margin = np.zeros(distance.shape, dtype=np.int64), np.full(distance.shape, -np.inf)
        packets[:, near], margin[:, near] = self._transfers(places, distance[:, near], which)
        hold = _probability(margin)
        if not self.failures.none:
            hold *= self.failures.alive(slice(None) if ids is None else ids)
        return ExpectedLinks(distance, packets, hold, margin)

    def _transfers(self, places: FloatArray, metres: FloatArray, which: IntArray) -> tuple[IntArray, FloatArray]:
        """Packets and margins of links, as :class:`ExpectedLinks` has them, ``(P, n)`` each, to sensors ``(n,)``."""
        mean, deviation = self.radio_map.predict(places, which)
        packets, margin = np.empty(metres.shape, dtype=np.int64), np.empty(metres.shape)
        link_expectations.expected_transfers(
            self._budget, self.share, np.ascontiguousarray(metres), mean, deviation, packets, margin
        )
        return packets, margin

    def packets(self, position: Point, place: FloatArray, sensor: int, *, held: bool) -> int:
        """Packets that a step moves from a sensor to a UAV here, if the link worked or probably works, else 0.

        0 too for a sensor of unknown position.
        """
        metres = math.hypot(position[0] - place[0], position[1] - place[1])
        # Most sensors are out of radio range, and computing one transfer takes as long as computing many.
        if not metres <= self._scenario.radio_radius_m:
            return 0
        distance, which = np.array([[metres]]), np.array([sensor])
        if self.by_formula:
            return int(ExpectedLinks.by_formula(distance, self._scenario).packets[0, 0])
        packets, margin = self._transfers(np.array([position]), distance, which)
        likely = held or (_probability(margin) * self.failures.alive(which))[0, 0] >= LIKELY
        return int(packets[0, 0]) if likely else 0

    def gain_db(self, place: FloatArray, distance: FloatArray, ids: IntArray) -> FloatArray:
        """The expected gains ``(n,)``, dB, at a UAV's place ``(2,)``."""
        loss = path_loss_db(distance, self._scenario)
        if self.radio_map.exact:
            return -loss
        return np.asarray(-(loss + self.radio_map.predict(place[None], ids)[0][0]))

    def transmitted(self, sensor: int, failed: bool, loss_db: float) -> bool:
        """Learn from the outcome of a transmission; returns whether the sensor's radio failed."""
        good = loss_db < self._scenario.path_loss_limit_db - GOOD_LINK_DB
        if good:
            self.failures.settle(sensor, failed)
        return good and failed

    def transfer(self, loss_db: float) -> tuple[float, int]:
        """A packet's energy, joules, and the packets that a step moves, over a link of this loss.

        The link is in radio range; no packets move where the loss is not below the threshold.
        """
        packet_j, packets = link_expectations.transfer(self._budget, loss_db)
        return packet_j, packets if loss_db < self._scenario.path_loss_limit_db else 0

    def moved(self, packets: float, before: float, link: int, slack: float) -> None:
        """Learn the rate share from a visit.

        Args:
            packets: that left the queue, estimated.
            before: in the queue.
            link: packets that the whole rate moves in a step.
            slack: the estimate's error, packets.
        """
        if link <= 0 or (packets >= before - slack and before < self.share * link):
            # The visit emptied the queue: the link may be able to move more.
            return
        self._see([*self._shares[1:], min(max(packets / link, _LEAST_SHARE), 1.0)])

    def _see(self, shares: list[float]) -> None:
        median = sorted(shares)[_SHARE_VISITS // 2]
        self._shares, self.share = shares, 1.0 if median > _WHOLE_SHARE else median

    def state_dict(self) -> dict[str, Any]:
        """The whole knowledge, as copies."""
        return {
            "map": self.radio_map.state_dict(),
            "failures": self.failures.state_dict(),
            "shares": list(self._shares),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        self.radio_map.load_state_dict(state["map"])
        self.failures.load_state_dict(state["failures"])
        self._see(list(state["shares"]))


def _probability(margin: FloatArray) -> FloatArray:
    """``Phi(margin)`` within 0.01, by the logistic function: the standard library has no vectorised erf."""
    return np.asarray(1.0 / (1.0 + np.exp(np.minimum(np.maximum(-1.702 * margin, -50.0), 50.0))))
