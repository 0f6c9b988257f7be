"""Training of the attention and velocity modules on recorded rollouts, as ``python -m lab pretrain`` describes it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress, track
from rich.table import Table
from torch import Tensor
from torch.nn import functional

from lab.exploration.rollouts import read_rollouts
from lab.training.modules import Modules
from lab.training.options import Pretrain
from lab.training.reward import Reward
from lab.training.rollout_examples import Choices, Example, ExampleBatch, replay
from lab.training.teacher_agreement import recall, references, velocity_agreement, velocity_error
from service.learning.initial_weights import initial_weights
from shared.world.scenario import Scenario


def pretrain(args: Pretrain, console: Console) -> None:
    """Train, print the quality of the modules, and write the checkpoint.

    Raises:
        OSError: the rollouts cannot be read, or the checkpoint cannot be written.
        ValueError: the rollouts are invalid, or too few.
    """
    # More threads sum in another order, and are not faster with such small modules.
    torch.set_num_threads(1)
    reward = Reward(args.target, args.horizon, args.discount)
    recordings = [_replayed(path, reward, args, console) for path in args.rollouts]
    levels = _levels(recordings)
    train, test = ([*chain.from_iterable(missions)] for missions in zip(*map(_split, recordings), strict=True))
    modules = fit(ExampleBatch.of(train, args.speed), ExampleBatch.of(test, args.speed), levels, args, console)
    for recording in recordings:
        console.print(_report(modules, recording, args, levels))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    modules.save(args.out)


@dataclass(frozen=True)
class _Recording:
    """One file's scenario, and its missions' examples."""

    path: Path
    scenario: Scenario
    missions: list[list[Example]]


def _replayed(path: Path, reward: Reward, args: Pretrain, console: Console) -> _Recording:
    header, steps = read_rollouts(path)
    replayed = replay(header, steps, reward, args.features, args.belief)
    description = f"Replaying {header.scenario.name}"
    return _Recording(path, header.scenario, [*track(replayed, description, header.missions, console=console)])


def _levels(recordings: Sequence[_Recording]) -> int:
    """The number of velocities, which all files have in common."""
    first = recordings[0]
    for recording in recordings:
        if recording.scenario.max_velocity != first.scenario.max_velocity:
            raise ValueError(
                f"UAVs fly up to {first.scenario.max_velocity} m/s in {first.path}, "
                f"and up to {recording.scenario.max_velocity} m/s in {recording.path}"
            )
    return first.scenario.max_velocity + 1


def _split(recording: _Recording) -> tuple[list[Example], list[Example]]:
    """The examples to train on, and those held out: of every eleventh mission.

    Teachers alternate, and each gets its share this way.
    """
    missions = recording.missions
    held_out = set(range(10, len(missions), 11)) or {len(missions) - 1}
    train = [example for n, mission in enumerate(missions) if n not in held_out for example in mission]
    test = [example for n in sorted(held_out) for example in missions[n]]
    if not train or not test:
        raise ValueError(f"{recording.path} has {len(missions)} missions; at least 2 are needed")
    return train, test


def _report(modules: Modules, recording: _Recording, args: Pretrain, levels: int) -> Table:
    """The agreement of these modules, the shipped ones and random ones with each teacher on the held-out missions."""
    ranked = {"random": Modules(args.features, levels, args.seed).weights()}
    # The shipped checkpoint may be missing or of another shape, before this command makes it.
    with suppress(OSError, RuntimeError):
        ranked["shipped"] = initial_weights("pretrained", args.features, levels, args.seed)
    ranked["trained"] = modules.weights()
    title = f"Scenario {recording.scenario.name}, features {args.features}, target {args.target}"
    table = Table("held-out missions", *ranked, title=title)
    for teacher, taught in references(_split(recording)[1]).items():
        for k in (1, 3, 5):
            table.add_row(
                f"{teacher}'s sensor in the top {k}", *(f"{recall(m, taught, k):.3f}" for m in ranked.values())
            )
        equal = (f"{velocity_agreement(m, taught):.3f}" for m in ranked.values())
        table.add_row(f"{teacher}'s velocity", *equal)
        off = (f"{velocity_error(m, taught):.1f} m/s" for m in ranked.values())
        table.add_row(f"mean difference from {teacher}'s velocity", *off)
    return table


def losses(modules: Modules, batch: ExampleBatch, temperature: float = 1.0) -> tuple[Tensor, Tensor]:
    """Mean value regression, and mean cross-entropy that ranks the teacher's sensor, and a velocity for it, first.

    ``(s_j - r)^2 + (u_v - r)^2`` of the recorded decision, and
    ``-ln softmax(s / temperature)_j* - ln softmax(u / temperature)_v*`` of the reference j*, v*.
    The first term (ListNet's top-one probability, Cao et al., ICML 2007, with one relevant sensor) counts only where j*
    can send something.
    """
    scores, z = modules.attention(batch.features, batch.admissible)
    rows = torch.arange(len(batch))

    def values(choices: Choices) -> Tensor:
        u: Tensor = modules.velocity(z[rows, choices.chosen], choices.approach)
        return u

    predicted = scores[rows, batch.logged.chosen], values(batch.logged)[rows, batch.logged.velocity]
    regression = sum(((guess - batch.reward) ** 2).mean() for guess in predicted)
    logits = scores.masked_fill(~batch.admissible, -torch.inf) / temperature
    sensor = functional.cross_entropy(logits, batch.teacher.chosen, reduction="none")
    velocity = functional.cross_entropy(values(batch.teacher) / temperature, batch.teacher.velocity, reduction="none")
    return torch.as_tensor(regression), (sensor * batch.reaches + velocity * batch.taught).mean()


def fit(train: ExampleBatch, test: ExampleBatch, levels: int, args: Pretrain, console: Console) -> Modules:
    """Minibatch Adam with a cosine schedule; prints the held-out loss after every epoch."""
    modules = Modules(args.features, levels, args.seed)
    adam = torch.optim.Adam(modules.parameters(), lr=args.learning_rate)
    batches = -(-len(train) // args.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, args.epochs * batches, args.learning_rate / 10)
    shuffle = torch.Generator().manual_seed(args.seed)
    weight = args.ranking if args.target == "return" else 0.0
    mean = train.reward.mean()
    console.print(f"{len(train)} decisions, mean reward {mean:.3f}, {int(train.taught.sum())} taught")
    console.print(f"held out {len(test)}, loss of the mean alone {2 * ((test.reward - mean) ** 2).mean():.4f}")
    with Progress(console=console) as progress:
        task = progress.add_task("Training", total=args.epochs * batches)
        for epoch in range(1, args.epochs + 1):
            for rows in torch.split(torch.randperm(len(train), generator=shuffle), args.batch):
                adam.zero_grad()
                regression, ranking = losses(modules, train[rows], args.temperature)
                (regression + weight * ranking).backward()  # type: ignore[no-untyped-call]
                adam.step()
                schedule.step()
                progress.advance(task)
            with torch.inference_mode():
                regression, ranking = losses(modules, test, args.temperature)
            console.print(f"epoch {epoch}: held-out loss {regression:.4f}, of ranking {ranking:.4f}")
    return modules
