import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from service.attention import Attention, top_k


def reference(
    x: NDArray[np.float64], mask: NDArray[np.bool_], attention: Attention
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The module in ten lines of numpy, with masked sensors at minus infinity before the softmax."""
    weights = {name: p.detach().numpy().astype(np.float64) for name, p in attention.named_parameters()}
    q, k, v = (x @ weights[f"{name}.weight"].T for name in ("query", "key", "value"))
    logits = np.where(mask, q @ k.T / np.sqrt(q.shape[1]), -np.inf)
    alpha = np.exp(logits - logits.max(axis=1, keepdims=True))
    alpha /= alpha.sum(axis=1, keepdims=True)
    z = alpha @ v
    return z @ weights["score.weight"][0] + weights["score.bias"][0], z


@pytest.mark.parametrize("seed", range(5))
def test_equals_a_numpy_reference_with_masked_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, mask = rng.normal(size=(10, 5)), rng.random(10) < 0.7
    mask[0] = True
    torch.manual_seed(seed)
    attention = Attention(5)
    scores, z = attention(torch.from_numpy(x[mask].astype(np.float32)))
    expected_scores, expected_z = reference(x, mask, attention)
    np.testing.assert_allclose(scores.detach().numpy(), expected_scores[mask], atol=1e-5)
    np.testing.assert_allclose(z.detach().numpy(), expected_z[mask], atol=1e-5)


def test_a_masked_sensor_changes_nothing() -> None:
    """The reference agrees: whatever stands in a masked row, the others' numbers stay."""
    rng = np.random.default_rng(1)
    x, mask = rng.normal(size=(6, 5)), np.array([True, True, False, True, False, True])
    attention = Attention(5)
    before, _ = reference(x, mask, attention)
    x[~mask] = 1e3
    after, _ = reference(x, mask, attention)
    np.testing.assert_array_equal(before[mask], after[mask])


def test_top_k_is_best_first_and_never_more_than_there_are() -> None:
    scores = torch.tensor([0.1, 3.0, -1.0, 2.0])
    assert top_k(scores, 3) == [1, 3, 0]
    assert top_k(scores, 9) == [1, 3, 0, 2]
