import subprocess
import sys
from collections.abc import Callable
from functools import partial
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch

from lab.training.modules import Modules
from service.learning.initial_weights import initial_parameters, initial_weights
from service.learning.learner import Learner
from service.learning.modules import WIDTH, Sample
from service.learning.training_step import descend
from shared.features.augmented_state import FEATURES, LEVEL_FEATURES
from shared.wire.schemas import Features

Scores = tuple[float, ...]

PRESETS: list[Features] = ["paper", "reach"]


def sample(preset: Features = "paper", seed: int = 0, sensors: int = 6) -> Sample:
    rng = np.random.default_rng(seed)
    features = rng.random((sensors, FEATURES[preset]), dtype=np.float32)
    approach = rng.random(1 if preset == "paper" else (15, LEVEL_FEATURES), dtype=np.float32)
    return Sample(features=features, chosen=min(2, sensors - 1), approach=approach, velocity=7)


@pytest.mark.parametrize("preset", PRESETS)
def test_gradient_equals_a_finite_difference(preset: Features) -> None:
    modules = Modules(preset, 15, seed=3).double()
    case = sample(preset)._replace(features=sample(preset).features.astype(np.float64))
    modules.loss(case, reward=-0.8).backward()  # type: ignore[no-untyped-call]
    for name, parameter in modules.named_parameters():
        assert parameter.grad is not None, name
        flat, gradient = parameter.data.view(-1), parameter.grad.view(-1)
        for index in range(0, len(flat), max(1, len(flat) // 7)):
            step, old = 1e-6, flat[index].item()
            losses = []
            for shifted in (old + step, old - step):
                flat[index] = shifted
                losses.append(modules.loss(case, reward=-0.8).item())
            flat[index] = old
            assert abs((losses[0] - losses[1]) / (2 * step) - gradient[index].item()) < 1e-6, (name, index)


@pytest.mark.parametrize("preset", PRESETS)
def test_both_modules_learn_jointly_and_the_loss_falls(preset: Features) -> None:
    learner = Learner(Modules(preset, 15, seed=0).weights(), learning_rate=5e-3)
    before = learner.state_dict()["weights"]
    losses = [learner.update(sample(preset), cost=1.0) for _ in range(200)]
    assert losses[-1] < 0.05 * losses[0]
    after = learner.state_dict()["weights"]
    assert {name.split(".")[0] for name in after if not np.array_equal(after[name], before[name])} == {
        "attention",
        "velocity",
    }
    assert learner.updates == 200


@pytest.mark.parametrize("sensors", [1, 2, 10, 1000])
@pytest.mark.parametrize("preset", PRESETS)
def test_a_lessons_gradient_is_autograds(preset: Features, sensors: int) -> None:
    for seed in range(20):
        modules = Modules(preset, 15, seed=seed)
        case, cost = sample(preset, seed, sensors), 0.1 * seed
        loss = modules.loss(case, -cost)
        expected = torch.autograd.grad(loss, list(modules.parameters()))
        weights = modules.weights()
        found = weights.layout.arrays(np.zeros_like(weights.flat))
        reported = descend(weights.parameters, case, -cost, into=found)
        assert reported == pytest.approx(loss.item(), rel=1e-4, abs=1e-9)
        for name, mine, its in zip(weights.layout.names, found, expected, strict=True):
            atol = 1e-5 * (1 + float(its.abs().max()))
            np.testing.assert_allclose(mine, its.numpy(), rtol=1e-3, atol=atol, err_msg=name)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_lesson_is_a_step_of_torchs_adam(preset: Features) -> None:
    modules = Modules(preset, 15, seed=1)
    adam = torch.optim.Adam(modules.parameters(), lr=5e-3)
    learner = Learner(Modules(preset, 15, seed=1).weights(), learning_rate=5e-3)
    for seed in range(60):
        weights = learner.weights
        gradient = weights.layout.arrays(np.zeros_like(weights.flat))
        descend(weights.parameters, sample(preset, seed), -0.3, into=gradient)
        for parameter, its in zip(modules.parameters(), gradient, strict=True):
            parameter.grad = torch.from_numpy(its.copy())
        adam.step()
        learner.update(sample(preset, seed), cost=0.3)
    kept = learner.state_dict()
    for name, values in modules.state_dict().items():
        np.testing.assert_allclose(kept["weights"][name], values.numpy(), rtol=1e-5, atol=1e-6, err_msg=name)
    for index, moments in adam.state_dict()["state"].items():
        for name, value in moments.items():
            np.testing.assert_allclose(kept["adam"][index][name], value.numpy(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("sensors", [1, 2, 10, 63, 64, 200])
def test_decisions_compute_what_the_modules_compute(preset: Features, sensors: int) -> None:
    for seed in range(10):
        modules, case = Modules(preset, 15, seed=seed), sample(preset, seed, sensors)
        with torch.no_grad():
            scores, values = modules.evaluate(case)
        found, contexts = modules.weights().attend(case.features)
        np.testing.assert_allclose(found, scores.numpy(), atol=2e-6)
        levels = modules.weights().velocities(contexts([case.chosen]), case.approach[None])[0]
        np.testing.assert_allclose(levels, values.numpy(), atol=2e-6)


def test_a_lesson_that_is_not_finite_changes_nothing() -> None:
    learner = Learner(initial_weights("pretrained", "paper", 15, 0), learning_rate=1e-3)
    learner.update(sample(), cost=0.3)
    broken = sample(seed=1)
    broken.features[3, 0] = np.nan
    before = learner.state_dict()
    with pytest.raises(FloatingPointError, match="not finite"):
        learner.update(broken, cost=0.3)
    after = learner.state_dict()
    assert after["updates"] == before["updates"] == 1
    np.testing.assert_equal(after, before)
    assert np.isfinite(learner.update(sample(seed=2), cost=0.3))


def test_what_was_kept_goes_on_as_if_it_had_never_stopped() -> None:
    through, first = (Learner(Modules("reach", 15, seed=1).weights(), learning_rate=5e-3) for _ in range(2))
    for seed in range(20):
        through.update(sample("reach", seed), cost=0.3)
    for seed in range(10):
        first.update(sample("reach", seed), cost=0.3)
    again = Learner(Modules("reach", 15, seed=7).weights(), learning_rate=5e-3)
    again.load_state_dict(first.state_dict())
    for seed in range(10, 20):
        again.update(sample("reach", seed), cost=0.3)
    assert np.array_equal(
        again.weights.attend(sample("reach").features).scores, through.weights.attend(sample("reach").features).scores
    )
    with pytest.raises(ValueError):
        Learner(Modules("paper", 15, seed=1).weights(), learning_rate=5e-3).load_state_dict(first.state_dict())


def test_missions_share_modules_and_until_they_learn_the_pretrained_weights() -> None:
    one, other, alone = (Learner(initial_weights("pretrained", "reach", 15, n), learning_rate=5e-3) for n in range(3))
    assert one.weights is other.weights
    for seed in range(20):
        one.update(sample("reach", seed), cost=0.3)
        other.update(sample("reach", 100 + seed), cost=1.3)
    for seed in range(20):
        alone.update(sample("reach", seed), cost=0.3)
    scores = [learner.weights.attend(sample("reach").features).scores for learner in (one, other, alone)]
    assert np.array_equal(scores[0], scores[2])
    assert not np.array_equal(scores[0], scores[1])
    assert not np.array_equal(
        scores[0], initial_weights("pretrained", "reach", 15, 0).attend(sample("reach").features).scores
    )


def test_what_other_modules_learned_is_refused() -> None:
    learner = Learner(Modules("paper", 15, seed=0).weights(), learning_rate=5e-4)
    for other in (Modules("reach", 15, seed=0), Modules("paper", 9, seed=0)):
        with pytest.raises(ValueError, match="do not have the shapes"):
            learner.load_state_dict(Learner(other.weights(), learning_rate=5e-4).state_dict())


def at_every_line(lesson: Callable[[], object], look: Callable[[], Scores]) -> list[Scores]:
    """What is seen before each line of the service that a lesson runs, as another thread may look."""
    seen: list[Scores] = []

    def trace(frame: FrameType, event: str, _: object) -> Callable[..., Any] | None:
        if "/service/" not in frame.f_code.co_filename or frame.f_code.co_name.startswith("<"):
            return None
        seen.append(look())
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        lesson()
    finally:
        sys.settrace(before)
    return seen


def test_a_decision_never_sees_half_a_step() -> None:
    features = sample("reach", 99).features
    learner = Learner(Modules("reach", 15, seed=1).weights(), learning_rate=0.1)

    def scores() -> Scores:
        return tuple(learner.weights.attend(features).scores.tolist())

    for seed in range(3):
        in_hand, before = learner.weights, scores()
        seen = at_every_line(partial(learner.update, sample("reach", seed), cost=0.3), scores)
        after = scores()
        assert before != after
        assert len(seen) > 10 and {before, after} == {*seen, after}
        # Nor does a decision that was begun before the lesson: its copy is as it was.
        assert tuple(in_hand.attend(features).scores.tolist()) == before


def test_an_edge_decides_and_learns_without_torch_and_llama_cpp() -> None:
    # Their imports take seconds, and hundreds of megabytes.
    script = (
        "import sys; sys.modules['torch'] = sys.modules['xllamacpp'] = None;"
        "import service.api.app;"
        "from service.learning.initial_weights import initial_weights; from service.learning.learner import Learner;"
        "from service.learning.modules import Sample; import numpy as np;"
        "sample = Sample(np.ones((6, 5), np.float32), 2, np.ones(1, np.float32), 7);"
        "[Learner(initial_weights(init, 'paper', 15, 0), learning_rate=1e-3).update(sample, 0.3)"
        " for init in ('pretrained', 'random')]"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("seed", [0, 1, 2**32 + 5, 2**63 - 1])
@pytest.mark.parametrize(("preset", "added", "outputs"), [("paper", 1, 15), ("reach", LEVEL_FEATURES, 1)])
def test_random_weights_are_those_of_torchs_layers(preset: Features, added: int, outputs: int, seed: int) -> None:
    features = FEATURES[preset]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = [torch.nn.Linear(features, WIDTH, bias=False) for _ in range(3)]
        layers += [torch.nn.Linear(*shape) for shape in ((WIDTH, 1), (WIDTH + added, WIDTH), (WIDTH, outputs))]
    drawn = initial_parameters("random", preset, 15, seed).values()
    for ours, theirs in zip(drawn, (p for layer in layers for p in layer.parameters()), strict=True):
        assert np.array_equal(ours, theirs.detach().numpy())


def test_the_seed_decides_the_initial_weights() -> None:
    a, b, c = (initial_weights("random", "paper", 15, seed) for seed in (1, 1, 2))
    assert np.array_equal(a.flat, b.flat)
    assert not np.array_equal(a.flat, c.flat)
