import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn.attention import SDPBackend, sdpa_kernel

from lab.training.modules import Attention, Modules
from service.learning.modules import top_k


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


def test_a_batch_with_padding_gives_what_each_gives_alone() -> None:
    torch.manual_seed(0)
    attention, sizes = Attention(5), [4, 1, 6]
    alone = [torch.rand(n, 5) for n in sizes]
    padded = torch.nn.utils.rnn.pad_sequence(alone, batch_first=True, padding_value=9.0)
    scores, z = attention(padded, torch.arange(6) < torch.tensor(sizes)[:, None])
    for row, x in enumerate(alone):
        expected, contexts = attention(x)
        torch.testing.assert_close(scores[row, : len(x)], expected)
        torch.testing.assert_close(z[row, : len(x)], contexts)


def test_torchs_kernel_that_keeps_no_square_of_the_sensors_takes_it() -> None:
    attention = Attention(5)
    with torch.inference_mode(), sdpa_kernel(SDPBackend.FLASH_ATTENTION):
        scores, z = attention(torch.rand(10, 5))
    assert (scores.shape, z.shape) == ((10,), (10, 32))


@pytest.mark.parametrize("features", [5, 12, 17])
@pytest.mark.parametrize("sensors", [63, 64, 600, 3000])
def test_decisions_score_many_sensors_as_the_reference(sensors: int, features: int) -> None:
    torch.manual_seed(2)
    modules = Modules("paper", 15, seed=0)
    modules.attention = Attention(features)
    # Learned weights tell sensors apart more sharply than random ones.
    with torch.no_grad():
        modules.attention.query.weight *= 4
    x, rows = torch.rand(sensors, features).numpy(), [sensors - 1, 0, 17]
    scores, z = reference(x.astype(np.float64), np.ones(sensors, dtype=np.bool_), modules.attention)
    attended = modules.weights().attend(x)
    np.testing.assert_allclose(attended.scores, scores, atol=2e-6)
    np.testing.assert_allclose(attended.contexts(rows), z[rows], atol=2e-6)
    # Which rows are asked for at a time changes no bit of a velocity's value.
    np.testing.assert_array_equal(attended.contexts(rows[:1])[0], attended.contexts(rows)[0])


def test_a_masked_sensor_changes_nothing() -> None:
    """Whatever stands in a masked row, the others' numbers stay."""
    torch.manual_seed(1)
    attention, mask = Attention(5), torch.tensor([True, True, False, True, False, True])
    x = torch.rand(6, 5)
    before, contexts = attention(x, mask)
    x[~mask] = 1e3
    after, later = attention(x, mask)
    torch.testing.assert_close(after[mask], before[mask], rtol=0, atol=0)
    torch.testing.assert_close(later[mask], contexts[mask], rtol=0, atol=0)
    assert not torch.equal(after[~mask], before[~mask])


def test_top_k_is_best_first_and_never_more_than_there_are() -> None:
    scores = np.array([0.1, 3.0, -1.0, 2.0], dtype=np.float32)
    assert top_k(scores, 3) == [1, 3, 0]
    assert top_k(scores, 9) == [1, 3, 0, 2]


@pytest.mark.parametrize("k", [1, 5, 199, 200, 300])
def test_the_best_of_many_are_those_of_a_sort(k: int) -> None:
    random = np.random.default_rng(k)
    # Many are equal, many are ruled out, and an overflow gives no number.
    scores = random.integers(0, 20, 200).astype(np.float32)
    scores[random.random(200) < 0.5] = -np.inf
    scores[7] = np.nan
    assert top_k(scores, k) == (-scores).argsort(kind="stable")[:k].tolist()
