from __future__ import annotations

import numpy as np
import pytest

from shared.planning.orders import count_deadlines


def by_hand(every: int, since: int, last: int, visited: set[int]) -> tuple[int, int]:
    """Window by window."""
    windows = [set(range(end - every + 1, end + 1)) for end in range(since + every - 1, last + 1)]
    met = sum(bool(window & visited) for window in windows)
    return met, len(windows) - met


@pytest.mark.parametrize(
    ("every", "since", "last", "visited", "met", "missed"),
    [
        (3, 0, 5, [], 0, 4),
        (3, 0, 5, [2], 3, 1),
        (3, 0, 5, [0, 5], 2, 2),
        (1, 0, 2, [0, 2, 2], 2, 1),
        (3, 0, 1, [0], 0, 0),
        (3, 4, 8, [3], 0, 3),
        (2, 5, 4, [5], 0, 0),
    ],
)
def test_windows_with_and_without_a_visit(
    every: int, since: int, last: int, visited: list[int], met: int, missed: int
) -> None:
    assert count_deadlines(every, since, last, visited) == (met, missed)


def test_it_counts_as_one_does_by_hand() -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        every, since, length = (int(n) for n in rng.integers((1, 0, 0), (8, 20, 40)))
        visited = rng.integers(0, 60, rng.integers(0, 15)).tolist()
        last = since + length
        inside = {step for step in visited if since <= step <= last}
        assert count_deadlines(every, since, last, visited) == by_hand(every, since, last, inside)
