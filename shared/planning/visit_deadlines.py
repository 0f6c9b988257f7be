"""Visit deadlines: whether a sensor that is to be visited at least once in any n consecutive steps was."""

from collections.abc import Iterable


def count_deadlines(interval: int, since: int, last: int, visited: Iterable[int]) -> tuple[int, int]:
    """The numbers of deadlines met and missed of one sensor from step ``since`` to step ``last``.

    A deadline ends in every step whose last ``interval`` steps all lie in that time: the first in ``since + interval -
    1``. It is met if one of these steps had a visit.

    Args:
        visited: the steps of the visits, in any order; others than those from ``since`` to ``last`` do not count.
    """
    first = since + interval - 1
    met, through = 0, first - 1
    for step in sorted(step for step in visited if since <= step <= last):
        until = min(step + interval - 1, last)
        met += max(0, until - max(step - 1, through))
        through = max(through, until)
    return met, max(0, last - first + 1) - met
