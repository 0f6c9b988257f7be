"""A dict of bounded weight that drops its oldest entries."""

from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class BoundedDict(dict[K, V], Generic[K, V]):
    """The newest entries, in the order of their addition; a key that is set again keeps its position.

    Only ``[key] = value`` counts an entry's weight. A single entry stays whatever its weight.

    Args:
        most: the largest total weight of the entries.
        weight: returns a value's weight, by default 1.
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
        """Remove all entries."""
        super().clear()
        self._weight = 0

    def take(self, key: K) -> V | None:
        """Remove and return the value; None if there is none."""
        value = self.get(key)
        if value is not None:
            del self[key]
        return value
