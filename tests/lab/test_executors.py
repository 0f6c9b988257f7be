"""Tasks on processes of this machine; ``tests/e2e/test_ray.py`` has those on Ray."""

from __future__ import annotations

import math
import os
import sys

import pytest

from lab.executors import executor, ordered_map
from shared.kit.ray_connection import RayUnusable


@pytest.mark.parametrize("workers", [1, 2])
def test_a_map_is_in_order_and_raises_what_the_function_raised(workers: int) -> None:
    with ordered_map(workers, None) as each:
        assert list(each(math.factorial, range(5))) == [1, 1, 2, 6, 24]
        with pytest.raises(ValueError, match="negative"):
            list(each(math.factorial, [-1]))


def test_one_worker_is_this_process() -> None:
    with ordered_map(1, None) as each:
        assert list(each(lambda _: os.getpid(), [0])) == [os.getpid()]


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RayUnusable, match=r"pip install 'aic-vds\[ray\]'"), executor(1, "local"):
        pass
