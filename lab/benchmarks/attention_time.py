"""Microseconds of attention over J sensors, compared with its complexity O(J d_x d' + J^2 d') in the paper.

python -m lab.benchmarks.attention_time
"""

from __future__ import annotations

import statistics
import timeit

import numpy as np
import tyro

from service.learning.initial_weights import initial_weights
from shared.features.augmented_state import FEATURES

SENSORS = (10, 60, 100, 1000, 2000)


def microseconds(sensors: int) -> float:
    """The median time of one call, after calls that compile."""
    weights = initial_weights("pretrained", "paper", 15, 0)
    features = np.random.default_rng(0).random((sensors, FEATURES["paper"])).astype(np.float32)
    number = max(1, 20_000 // sensors)
    timeit.timeit(lambda: weights.attend(features), number=number)
    return 1e6 * statistics.median(timeit.repeat(lambda: weights.attend(features), number=number, repeat=9)) / number


def main() -> None:
    """Time the attention over 10 to 2,000 sensors."""
    for count in SENSORS:
        print(f"J = {count}: {microseconds(count):.0f} us")


if __name__ == "__main__":
    tyro.cli(main)
