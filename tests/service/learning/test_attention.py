import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn.attention import SDPBackend, sdpa_kernel

from service.learning.modules import Attention, AttentionWeights, attend_narrow, top_k


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


def weights_of(attention: Attention) -> AttentionWeights:
    query, key, value, score = attention.query, attention.key, attention.value, attention.score
    tensors = query.weight, key.weight, value.weight, score.weight, score.bias
    return AttentionWeights(*(tensor.detach() for tensor in tensors))


@pytest.mark.parametrize("sensors", [512, 2047, 2048, 4097])
def test_many_sensors_are_shared_among_cores_and_give_the_same_to_the_bit(
    sensors: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(1)
    weights, x = weights_of(Attention(12)), torch.rand(sensors, 12)
    monkeypatch.setattr("service.learning.modules.usable_cores", lambda: 1)
    at_once = attend_narrow(weights, x)
    for cores in (2, 3, 16):
        monkeypatch.setattr("service.learning.modules.usable_cores", lambda cores=cores: cores)
        shared = attend_narrow(weights, x)
        assert torch.equal(shared[0], at_once[0])
        assert torch.equal(shared[1], at_once[1])


@pytest.mark.parametrize(("sensors", "features"), [(1, 5), (600, 5), (600, 12), (3000, 12), (600, 17)])
def test_heads_as_wide_as_the_features_give_the_same_scores(sensors: int, features: int) -> None:
    torch.manual_seed(2)
    attention = Attention(features)
    # Learned weights tell sensors apart more sharply than random ones.
    with torch.no_grad():
        attention.query.weight *= 4
    x = torch.rand(sensors, features)
    expected = reference(x.numpy().astype(np.float64), np.ones(sensors, dtype=np.bool_), attention)
    for found, wanted in zip(attend_narrow(weights_of(attention), x), expected, strict=True):
        np.testing.assert_allclose(found.numpy(), wanted, atol=1e-5)


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
    scores = np.array([0.1, 3.0, -1.0, 2.0], dtype=np.float32)
    assert top_k(scores, 3) == [1, 3, 0]
    assert top_k(scores, 9) == [1, 3, 0, 2]
