"""The state block without pruning and masks: the baseline for the tokens saved.

This block is never sent, so its tokens are counted without writing it. Apart from the digits, a row's tokens depend
only on which of its numbers are negative or unknown; the digits of a number cost one token for every three. This way
10,000 rows take a millisecond; writing and tokenizing them takes a hundred.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from service.prompting.row_formats import ALWAYS_KNOWN, UNKNOWN, Cells, full_columns
from shared.features import State

# The tokenizer makes a token of every three digits, from the left.
_DIGITS_A_TOKEN = 3
_MOST_DIGITS = 18
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
        names, numbers, unknown = self._numbers()
        lines = [
            self.write({n: UNKNOWN if u else str(v) for n, v, u in zip(names, row, missing, strict=True)})
            for row, missing in zip(numbers.tolist(), unknown.tolist(), strict=True)
        ]
        return self.head + "".join(lines)

    def tokens(self, count: Callable[[str], int]) -> int:
        """``count(text)``, for a tokenizer that splits digits and lines as o200k_base does."""
        names, numbers, unknown = self._numbers()
        digits = np.where(unknown, 0, 1)
        for more in range(_DIGITS_A_TOKEN, _MOST_DIGITS, _DIGITS_A_TOKEN):
            longer = np.abs(numbers) >= 10**more
            if not longer.any():
                break
            digits += longer & ~unknown
        kinds = np.where(unknown, 2, numbers < 0) @ 3 ** np.arange(len(names))
        total = count(self.head) if self.head else 0
        for kind, often in Counter(kinds.tolist()).items():
            text, known = _example_row(self.write, names, kind)
            total += often * (count(text) - known)
        return total + int(digits.sum())

    def _numbers(self) -> tuple[tuple[str, ...], NDArray[np.int64], NDArray[np.bool_]]:
        """The columns' names, their whole numbers ``(J, C)``, and which of these are unknown for want of a beacon."""
        columns = full_columns(self.state)
        always_known = np.array([name in ALWAYS_KNOWN for name in columns])
        numbers = np.rint(np.array(list(columns.values())).T).astype(np.int64)
        return tuple(columns), numbers, ~self.state.heard[:, None] & ~always_known


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
