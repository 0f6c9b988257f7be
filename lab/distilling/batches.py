"""The examples of each training step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch

# Batches whose examples are sorted by length together.
_SORTED = 16


class Batches:
    """Batches of examples of about one length, since a prompt with experiences is three times as long as one without.

    Each pass over all examples has its own order, drawn from the seed. Stretches of it are sorted by length and cut
    into batches, and the batches of a stretch are shuffled. The examples that are left over at the end of a pass,
    fewer than a batch, wait for the next one.

    Args:
        lengths: the length of each example.
        size: the examples of a batch; where there are fewer, some come twice.
    """

    def __init__(self, lengths: Sequence[int], size: int, seed: int) -> None:
        self._lengths = np.asarray(lengths)
        self._size, self._seed = size, seed
        self._of_pass = lru_cache(maxsize=2)(self._batches_of)

    def of(self, step: int) -> list[int]:
        """The examples' numbers, of the batch of that step."""
        in_a_pass = max(1, len(self._lengths) // self._size)
        return self._of_pass(step // in_a_pass)[step % in_a_pass]

    def _batches_of(self, number: int) -> list[list[int]]:
        generator = torch.Generator().manual_seed(self._seed * 1_000_003 + number)
        count, size = len(self._lengths), self._size
        order = torch.randperm(count, generator=generator).numpy()
        order = np.resize(order, max(1, count // size) * size)
        batches: list[list[int]] = []
        for first in range(0, len(order), _SORTED * size):
            stretch = order[first : first + _SORTED * size]
            stretch = stretch[np.argsort(self._lengths[stretch], kind="stable")].reshape(-1, size)
            shuffled = torch.randperm(len(stretch), generator=generator).numpy()
            batches += stretch[shuffled].tolist()
        return batches
