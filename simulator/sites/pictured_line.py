"""A pipeline for pictures: one line of its parts, with as many points as a scenario may have."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from shared.world.channel import FloatArray


def chained(parts: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """The parts as one line, each joined at its end that is nearest to an end of those before, from the first part.

    Args:
        parts: points ``(n, 2)`` each, metres.

    Returns:
        The line, ``(N, 2)``, and the widest gap that it joins, metres.
    """
    if not parts:
        return np.empty((0, 2)), 0.0
    # As complex numbers distances take a fraction of the time.
    ends = np.array([(complex(*part[0]), complex(*part[-1])) for part in parts])
    line, widest = deque([parts[0]]), 0.0
    ends[0] = np.inf
    for _ in parts[1:]:
        gaps = np.stack([np.abs(ends - complex(*at)) for at in (line[0][0], line[-1][-1])])
        after, index, last = (int(at) for at in np.unravel_index(np.argmin(gaps), gaps.shape))
        widest = max(widest, float(gaps[after, index, last]))
        part = parts[index] if after != last else parts[index][::-1]
        ends[index] = np.inf
        if after:
            line.append(part)
        else:
            line.appendleft(part)
    return np.concatenate(line), widest


def simplified(line: FloatArray, most: int) -> FloatArray:
    """The line ``(N, 2)`` without the points that change it least, at most ``most``; the ends stay."""
    while (excess := len(line) - most) > 0:
        odd = np.arange(1, len(line) - 1, 2)
        (x1, y1), (x2, y2) = (line[odd] - line[odd - 1]).T, (line[odd + 1] - line[odd - 1]).T
        areas = np.abs(x1 * y2 - y1 * x2)
        line = np.delete(line, odd[np.argsort(areas, kind="stable")[:excess]], axis=0)
    return line
