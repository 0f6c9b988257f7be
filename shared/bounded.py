"""A dict that forgets: of too many entries, the one that was added first."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class BoundedDict(dict[K, V], Generic[K, V]):
    """The newest entries, in the order added; a key that is set again keeps its place.

    Only what is set by ``[key] = value`` counts. A single entry is kept whatever it weighs.

    Args:
        most: what the entries may weigh together.
        weight: of a value; 1 of each unless given.
    """

    def __init__(self, most: int, weight: Callable[[V], int] = lambda _: 1) -> None:
        super().__init__()
        self._most = most
        self._weigh = weight
        self._weight = 0

    def __setitem__(self, key: K, value: V) -> None:
        if key in self:
            self._weight -= self._weigh(self[key])
        super().__setitem__(key, value)
        self._weight += self._weigh(value)
        while self._weight > self._most and len(self) > 1:
            del self[next(iter(self))]

    def __delitem__(self, key: K) -> None:
        self._weight -= self._weigh(self[key])
        super().__delitem__(key)

    def clear(self) -> None:
        """Forget all."""
        super().clear()
        self._weight = 0

    def take(self, key: K) -> V | None:
        """The value, which is no longer kept; None where there is none."""
        value = self.get(key)
        if value is not None:
            del self[key]
        return value
