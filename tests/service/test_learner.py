from dataclasses import replace

import numpy as np
import pytest
import torch

from service.features import FEATURES
from service.learner import Learner, Modules, Sample
from service.reach import LEVEL_FEATURES
from shared.wire import Features

PRESETS: list[Features] = ["paper", "reach"]


def sample(preset: Features = "paper", seed: int = 0) -> Sample:
    rng = np.random.default_rng(seed)
    features = rng.random((6, FEATURES[preset]), dtype=np.float32)
    approach = rng.random(1 if preset == "paper" else (15, LEVEL_FEATURES), dtype=np.float32)
    return Sample(features=features, chosen=2, approach=approach, velocity=7)


@pytest.mark.parametrize("preset", PRESETS)
def test_gradient_equals_a_finite_difference(preset: Features) -> None:
    modules = Modules(preset, 15, seed=3).double()
    case = replace(sample(preset), features=sample(preset).features.astype(np.float64))
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
    learner = Learner(Modules(preset, 15, seed=0), learning_rate=5e-3)
    before = {name: p.clone() for name, p in learner.current.named_parameters()}
    losses = [learner.update(sample(preset), cost=1.0) for _ in range(200)]
    assert losses[-1] < 0.05 * losses[0]
    moved = {name.split(".")[0] for name, p in learner.current.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {"attention", "velocity"}
    assert learner.updates == 200


def test_a_decision_holds_a_finished_copy_while_learning_goes_on() -> None:
    learner = Learner(Modules("paper", 15, seed=0), learning_rate=5e-3)
    held = learner.current
    scores, _ = held.score(sample().features)
    learner.update(sample(), cost=1.0)
    again, _ = held.score(sample().features)
    assert torch.equal(scores, again)
    assert learner.current is not held


def test_the_seed_decides_the_initial_weights_and_leaves_torch_alone() -> None:
    state = torch.random.get_rng_state()
    a, b, c = Modules("paper", 15, seed=1), Modules("paper", 15, seed=1), Modules("paper", 15, seed=2)
    assert torch.equal(torch.random.get_rng_state(), state)
    scores = [m.score(sample().features)[0] for m in (a, b, c)]
    assert torch.equal(scores[0], scores[1])
    assert not torch.equal(scores[0], scores[2])
