"""The state block as it would be with nothing pruned and nothing masked: what the tokens saved are reckoned against.

Nobody is ever sent it, so it is counted without being written: what a row costs but for its numbers depends only on
which of them are negative or unknown, and a number costs a token for every three digits. So 10,000 rows take a
millisecond, where to write and to tokenize them takes a hundred.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from service.prompting.row_formats import ALWAYS_KNOWN, UNKNOWN, Cells, full_columns
from shared.features import State

# How the tokenizer splits digits: three at a time, from the left, each a token.
_DIGITS_A_TOKEN = 3
_MOST_DIGITS = 18
# What stands for a number while what is around it is counted; one token, and no zero, which has no sign.
_ANY = "5"


@dataclass(frozen=True, slots=True)
class Uncompressed:
    """Every sensor that was reported, as an LLM would have to see it.

    Args:
        state: the sensors.
        write: one sensor's line, ended by a line break.
        head: what stands above the rows: nothing, or whole lines.
    """

    state: State
    write: Callable[[Cells], str]
    head: str = ""

    def under(self, head: str) -> Uncompressed:
        """With more above the rows."""
        return replace(self, head=head + self.head)

    @property
    def text(self) -> str:
        """All of it."""
        names, numbers, unknown = self._numbers()
        lines = [
            self.write({n: UNKNOWN if u else str(v) for n, v, u in zip(names, row, gone, strict=True)})
            for row, gone in zip(numbers.tolist(), unknown.tolist(), strict=True)
        ]
        return self.head + "".join(lines)

    def tokens(self, count: Callable[[str], int]) -> int:
        """As many as ``count`` would find in ``text``, where it splits digits off, and lines, as o200k_base does."""
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
            text, known = _example(self.write, names, kind)
            total += often * (count(text) - known)
        return total + int(digits.sum())

    def _numbers(self) -> tuple[tuple[str, ...], NDArray[np.int64], NDArray[np.bool_]]:
        """The columns' names, their whole numbers ``(J, C)``, and which of these only a beacon could have told."""
        columns = full_columns(self.state)
        told = np.array([name in ALWAYS_KNOWN for name in columns])
        numbers = np.rint(np.array(list(columns.values())).T).astype(np.int64)
        return tuple(columns), numbers, ~self.state.heard[:, None] & ~told


@lru_cache(maxsize=256)
def _example(write: Callable[[Cells], str], names: tuple[str, ...], kind: int) -> tuple[str, int]:
    """A row, and how many of its numbers are known.

    Args:
        kind: of each number a digit to the base 3, the first's last: 0, or 1 for a negative one, or 2 for an unknown.
    """
    cells, known = {}, 0
    for name in names:
        kind, sign = divmod(kind, 3)
        cells[name] = (_ANY, f"-{_ANY}", UNKNOWN)[sign]
        known += sign < 2
    return write(cells), known
