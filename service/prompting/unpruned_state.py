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

from service.prompting.rows import ALWAYS_KNOWN, UNKNOWN, Cells, full_columns
from shared.features.augmented_state import State

# The placeholder for a number while the text around it is counted: one token, and not zero, which has no sign.
_PLACEHOLDER = "5"


@dataclass(frozen=True, slots=True)
class UnprunedState:
    """The rows of every reported sensor.

    Args:
        state: the sensors.
        write: writes one sensor's line, which ends with a line break.
        head: whole lines above the rows.
    """

    state: State
    write: Callable[[Cells], str]
    head: str = ""

    @property
    def text(self) -> str:
        """The block's text."""
        columns = full_columns(self.state)
        names = tuple(columns)
        numbers = np.rint(np.array(list(columns.values())).T).astype(np.int64)
        unknown = ~self.state.heard[:, None] & _columns(names)[0]
        lines = [
            self.write({n: UNKNOWN if u else str(v) for n, v, u in zip(names, row, missing, strict=True)})
            for row, missing in zip(numbers.tolist(), unknown.tolist(), strict=True)
        ]
        return self.head + "".join(lines)

    def tokens(self, count: Callable[[str], int]) -> int:
        """``count(text)``, for a tokenizer that splits digits and lines as o200k_base does."""
        columns = full_columns(self.state)
        names = tuple(columns)
        numbers = np.rint(np.array(list(columns.values()))).astype(np.int64)
        needs_beacon, place_values = _columns(names)
        unknown = needs_beacon[:, None] & ~self.state.heard
        kinds, counts = np.unique(place_values @ np.where(unknown, 2, numbers < 0), return_counts=True)
        # The tokenizer makes one token of every three digits.
        tokens = 1 + np.floor(np.log10(np.maximum(np.abs(numbers), 1))).astype(np.int64) // 3
        total = int(tokens[~unknown].sum()) + (count(self.head) if self.head else 0)
        for kind, often in zip(kinds.tolist(), counts.tolist(), strict=True):
            text, known = _example_row(self.write, names, kind)
            total += often * (count(text) - known)
        return total


@lru_cache(maxsize=16)
def _columns(names: tuple[str, ...]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether each column needs a beacon, and its place value in a row's kind, see :func:`_example_row`."""
    return np.array([name not in ALWAYS_KNOWN for name in names]), 3 ** np.arange(len(names))


@lru_cache(maxsize=256)
def _example_row(write: Callable[[Cells], str], names: tuple[str, ...], kind: int) -> tuple[str, int]:
    """A row, and how many of its numbers are known.

    Args:
        kind: a number to the base 3 with one digit for each column, the first column's last: 1 for a negative number, 2
            for an unknown one, 0 for any other.
    """
    cells, known = {}, 0
    for name in names:
        kind, sign = divmod(kind, 3)
        cells[name] = (_PLACEHOLDER, f"-{_PLACEHOLDER}", UNKNOWN)[sign]
        known += sign < 2
    return write(cells), known
