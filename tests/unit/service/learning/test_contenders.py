import numpy as np
import pytest

from service.learning.contenders import contenders
from service.learning.softmax_means import Array, softmax_means


def drawn(seed: int, sensors: int, scale: float, outliers: float = 4.0) -> tuple[Array, Array, Array]:
    """Queries that follow the keys, as attention's do, and mostly one direction of them; some sensors are unlike."""
    random = np.random.default_rng(seed)
    keys = random.random((sensors, 12)) ** random.uniform(0.2, 5.0, 12)
    keys[: sensors // 100] *= random.uniform(0.0, outliers, (sensors // 100, 1))
    matrix = np.outer(random.normal(size=12), random.normal(size=12)) + 0.03 * random.normal(size=(12, 12))
    queries = scale * keys @ matrix
    found = [values.astype(np.float32) for values in (queries, keys, keys @ random.normal(size=12))]
    return found[0], found[1], found[2]


@pytest.mark.parametrize("scale", [0.0, 0.03, 0.3, 3.0, 100.0])
@pytest.mark.parametrize("best", [1, 5, 40])
def test_the_best_are_among_them(best: int, scale: float) -> None:
    for seed in range(10):
        queries, keys, values = drawn(seed, 1500 + seed, scale)
        means = softmax_means(queries, keys, values)
        rows = contenders(queries, keys, values, best)
        assert set(np.argsort(-means, kind="stable")[:best].tolist()) <= set(rows.tolist())
        assert (np.diff(rows) > 0).all()


def test_what_is_added_counts() -> None:
    queries, keys, values = drawn(0, 3000, 0.3, outliers=1.0)
    added = np.zeros(3000, dtype=np.float32)
    out = min(set(range(3000)) - set(contenders(queries, keys, values, 1).tolist()))
    added[out] = 100.0
    assert out in contenders(queries, keys, values, 1, added).tolist()


def test_most_sensors_are_ruled_out_where_they_are_much_alike() -> None:
    queries, keys, values = drawn(1, 5000, 0.3, outliers=1.0)
    assert 5 <= len(contenders(queries, keys, values, 5)) < 1500


def test_sensors_that_are_all_the_same_are_all_among_them() -> None:
    same = np.ones((700, 3), dtype=np.float32)
    assert contenders(same, same, same[:, 0], 2).tolist() == list(range(700))


def test_a_number_that_is_not_finite_rules_nothing_out() -> None:
    queries, keys, values = drawn(2, 2000, 0.3)
    values[7] = np.nan
    assert len(contenders(queries, keys, values, 5)) == 2000
