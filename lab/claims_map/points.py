"""The settings of the claims map: the numbers that the paper leaves open, varied around scenario ``paper``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from shared.world.scenario import SCENARIOS, Scenario

# Mean arrivals of a sensor, packets a step; each sensor's rate is uniform from 0.4 to 1.6 times as many, as in `paper`.
RATES = (0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0)
_SPREAD = 0.4, 1.6
# Shares of W from which an initial queue is drawn.
FILLS = ((0.9, 1.0), (0.3, 1.0), (0.3, 0.7), (0.0, 0.3))
# One field each, at the fullest initial queues and at some of the rates. A threshold of 104 dB is a radius of 230 m, of
# 107 dB one of 280 m; a visit moves 21 packets at a link share of 0.35 and 6 at 0.1.
VARIANTS: dict[str, dict[str, float]] = {
    "step 5 s": {"step_s": 5.0},
    "step 20 s": {"step_s": 20.0},
    "threshold 107 dB": {"path_loss_limit_db": 107.0},
    "threshold 104 dB": {"path_loss_limit_db": 104.0},
    "link share 0.35": {"link_share": 0.35},
    "link share 0.1": {"link_share": 0.1},
}
VARIED_RATES = (0.25, 0.5, 2.0, 5.0)


@dataclass(frozen=True)
class Point:
    """One setting: a row of the map (initial queues, or a variant), a column (the mean arrivals), and its world."""

    row: str
    rate: float
    scenario: Scenario

    @property
    def name(self) -> str:
        """Its name in files."""
        row = "".join(c if c.isalnum() or c == "." else "_" for c in self.row)
        return f"{row}-{self.rate:g}"


def fill_row(fill: tuple[float, float]) -> str:
    """The label of a row of initial queues."""
    return f"queues {fill[0]:g} to {fill[1]:g} W"


def _world(rate: float, fill: tuple[float, float], **fields: float) -> Scenario:
    low, high = (round(share * rate, 6) for share in _SPREAD)
    rates = {"arrival_rate_min": low, "arrival_rate_max": high}
    return SCENARIOS["paper"].model_copy(
        update={**rates, "initial_queue_min": fill[0], "initial_queue_max": fill[1], **fields}
    )


ROWS = (*map(fill_row, FILLS), *VARIANTS)


def points(quick: bool = False) -> list[Point]:
    """The 52 settings, the fuller initial queues and the variants first; for a quick look four of them."""

    def by_rate(fills: Sequence[tuple[float, float]], rates: Sequence[float] = RATES) -> list[Point]:
        return [Point(fill_row(fill), rate, _world(rate, fill)) for fill in fills for rate in rates]

    if quick:
        return by_rate(FILLS[:2], (0.25, 5.0))
    varied = [
        Point(row, rate, _world(rate, FILLS[0], **fields)) for row, fields in VARIANTS.items() for rate in VARIED_RATES
    ]
    return [*by_rate(FILLS[:2]), *varied, *by_rate(FILLS[2:])]
