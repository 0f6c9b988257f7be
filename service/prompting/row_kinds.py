"""The kinds of rows that determine their tokens, compiled as :mod:`shared.belief.kriging` is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared.kit.compiled import compiled
from shared.world.channel import FloatArray, IntArray


@compiled
def count_kinds(
    columns: FloatArray,
    needs_beacon: NDArray[np.bool_],
    place_values: IntArray,
    heard: NDArray[np.bool_],
    most: int,
    kinds: IntArray,
    counts: IntArray,
) -> tuple[int, int]:
    """Count the kinds of J rows of C whole numbers, and the tokens of their digits.

    A row's kind is a number to the base 3 with a digit for each column: 1 for a negative number, 2 for one unknown
    without a beacon, 0 for any other.

    Args:
        columns: shape ``(C, J)``; rounded to whole numbers.
        needs_beacon, place_values: shape ``(C,)``.
        heard: shape ``(J,)``.
        most: a token has fewer digits than this power of 10.
        kinds, counts: shape ``(J,)``, are written: the kinds found, and the number of rows of each.

    Returns:
        the number of kinds, and the tokens of all known digits.
    """
    found, tokens = 0, 0
    for row in range(columns.shape[1]):
        kind = 0
        for column in range(columns.shape[0]):
            if needs_beacon[column] and not heard[row]:
                kind += 2 * place_values[column]
                continue
            number = int(np.rint(columns[column, row]))
            if number < 0:
                kind += place_values[column]
                number = -number
            tokens += 1
            while number >= most:
                number //= most
                tokens += 1
        # There are a handful of kinds.
        known = 0
        while known < found and kinds[known] != kind:
            known += 1
        if known == found:
            kinds[found], counts[found] = kind, 0
            found += 1
        counts[known] += 1
    return found, tokens
