"""The faults of a mission: dead radios, departing UAVs, and a lower share of the links' rate."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.world.channel import FloatArray, IntArray
from shared.world.scenario import Scenario


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
