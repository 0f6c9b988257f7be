"""Radios that fail: a sensor whose transmissions fail over links that hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from shared.channel import FloatArray, IntArray

# The prior probability that a radio is dead, and the odds of a failure over a good link if it is, and if it works.
_PRIOR = math.log(0.01 / 0.99)
_FAILED = math.log(0.99 / 0.05)
_SENT = math.log(0.01 / 0.95)
# A dead radio is tried again as its odds fall back to the prior, by this much a step: after some 60 steps.
_FORGET = 0.05
_MOST = 4.0
# The loss has to be this far below the threshold for a failure to be the radio's, dB.
GOOD_LINK_DB = 0.5


class RadioFailures:
    """The log odds that each of J radios is dead, ``(J,)``, by Bayes' rule from the outcomes over good links."""

    def __init__(self, sensors: int) -> None:
        self._odds: FloatArray = np.full(sensors, _PRIOR)
        self._step = 0
        self.none = True

    def settle(self, sensor: int, failed: bool) -> None:
        """Take the outcome of a transmission whose link held."""
        if self.none and not failed:
            return
        self.none = False
        odds = float(self._odds[sensor]) + (_FAILED if failed else _SENT)
        self._odds[sensor] = min(max(odds, _PRIOR), _MOST)

    def advance(self, step: int) -> None:
        """Go to a step: the evidence of earlier ones counts less."""
        if step > self._step:
            if not self.none:
                self._odds = np.maximum(self._odds - _FORGET * (step - self._step), _PRIOR)
                self.none = bool((self._odds <= _PRIOR).all())
            self._step = step

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
        return {"odds": self._odds.copy(), "step": self._step, "none": self.none}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the odds."""
        self._odds, self._step, self.none = state["odds"], state["step"], state["none"]
