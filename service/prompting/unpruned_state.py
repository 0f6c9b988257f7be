"""The state block without pruning and masks, the baseline for the tokens saved: counted, and never sent.

It has full rows, also where the prompt's own rows are shorter (letters, or the compact prompt). Apart from the digits,
a row's tokens depend only on which of its numbers are negative or unknown; the digits of a number cost one token for
every three. Writing and tokenizing many rows would take a hundred times as long.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from service.prompting.rows import ALWAYS_KNOWN, UNKNOWN, row, whole_numbers
from shared.features.augmented_state import State

# The placeholder for a number while the text around it is counted: one token, and not zero, which has no sign.
_PLACEHOLDER = "5"


@dataclass(frozen=True, slots=True)
class UnprunedState:
    """The rows of every reported sensor.

    Args:
        state: the sensors.
        head: whole lines above the rows.
    """

    state: State
    head: str = ""

    def tokens_by_row(self, count: Callable[[str], int]) -> NDArray[np.int64]:
        """``count(line)`` of the sensors' lines ``(J,)``; o200k_base splits digits and lines as this does."""
        names, numbers = whole_numbers(self.state)
        needs_beacon, place_values = _columns(names)
        sizes, longer, signs = np.abs(numbers), 1000, (numbers < 0).astype(np.int64)
        if not self.state.heard.all():
            unknown = needs_beacon[:, None] & ~self.state.heard
            sizes[unknown], signs[unknown] = 0, 2
        kinds = place_values @ signs
        tokens = np.empty_like(kinds)
        for kind in set(kinds.tolist()):
            tokens[kinds == kind] = count(_example_row(names, kind))
        # The tokenizer makes one token of every three digits.
        while (above := sizes >= longer).any():
            tokens, longer = tokens + above.sum(axis=0), longer * 1000
        return tokens


@lru_cache(maxsize=16)
def _columns(names: tuple[str, ...]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether each column needs a beacon, and its place value in a row's kind, see :func:`_example_row`."""
    return np.array([name not in ALWAYS_KNOWN for name in names]), 3 ** np.arange(len(names))


@lru_cache(maxsize=256)
def _example_row(names: tuple[str, ...], kind: int) -> str:
    """A row whose known numbers have one digit.

    ``kind`` has a digit to the base 3 for each column, the first one's last: 1 negative, 2 unknown, 0 any other.
    """
    cells = {}
    for name in names:
        kind, sign = divmod(kind, 3)
        cells[name] = (_PLACEHOLDER, f"-{_PLACEHOLDER}", UNKNOWN)[sign]
    return row(cells)
