import numpy as np
import pytest
from numpy.typing import NDArray

from service.learning.softmax_means import Array, softmax_means


def exact(queries: Array, keys: Array, values: Array) -> NDArray[np.float64]:
    products = queries.astype(np.float64) @ keys.astype(np.float64).T
    weights = np.exp(products - products.max(axis=1, keepdims=True))
    means: NDArray[np.float64] = weights @ values.astype(np.float64) / weights.sum(axis=1)
    return means


def drawn(queries: int, keys: int, dimensions: int, scale: float = 1.0) -> tuple[Array, Array, Array]:
    random = np.random.default_rng([queries, keys, dimensions])
    shapes = (queries, dimensions), (keys, dimensions), (keys,)
    found = [random.normal(size=shape).astype(np.float32) for shape in shapes]
    return found[0] * np.float32(scale), found[1], found[2]


@pytest.mark.parametrize("dimensions", [1, 4, 5, 12])
@pytest.mark.parametrize("keys", [1, 2, 3, 4, 63, 64, 257, 1000])
def test_any_number_of_keys_and_dimensions_has_the_exact_means(keys: int, dimensions: int) -> None:
    case = drawn(300, keys, dimensions)
    np.testing.assert_allclose(softmax_means(*case), exact(*case), atol=2e-6)


@pytest.mark.parametrize("scale", [10.0, 100.0, 1000.0])
def test_products_that_differ_by_more_than_numbers_have_exponents(scale: float) -> None:
    case = drawn(300, 1000, 5, scale)
    products = case[0] @ case[1].T
    assert scale < 100 or np.ptp(products) > 2 * 127
    # A product itself has rounding errors that grow with it.
    np.testing.assert_allclose(softmax_means(*case), exact(*case), atol=2e-6 * scale)


@pytest.mark.parametrize("place", [0, 1, 2, 3, 501, 998, 999])
@pytest.mark.parametrize("product", [90.0, 300.0, 30_000.0])
def test_one_key_far_above_all_others_has_all_the_weight_wherever_it_is(product: float, place: int) -> None:
    queries, keys, values = np.ones((5, 1), dtype=np.float32), np.zeros((1000, 1), dtype=np.float32), np.zeros(1000)
    keys[place], values[place] = product, 7.0
    np.testing.assert_array_equal(softmax_means(queries, keys, values.astype(np.float32)), np.full(5, 7.0))


def test_products_far_below_zero_are_compared_with_each_other_alone() -> None:
    queries, keys = np.ones((3, 1), dtype=np.float32), np.full((6, 1), -5000.0, dtype=np.float32)
    values = np.arange(6, dtype=np.float32)
    np.testing.assert_allclose(softmax_means(queries, keys, values), [2.5, 2.5, 2.5])
