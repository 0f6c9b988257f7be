"""``aicvds pretrain``: the attention and velocity modules' start, learned from recorded rollouts."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.progress import Progress
from torch import Tensor
from torch.nn import functional
from tyro.conf import arg

from service.attention import top_k
from service.checkpoint import save
from service.examples import Batch, Choices, Example, replay
from service.learner import Modules
from shared.rollouts import read_rollouts
from shared.wire import Features


@dataclass(frozen=True)
class Pretrain:
    """Train the attention and velocity modules on recorded rollouts and write the checkpoint that missions start from.

    Record first:  aicvds explore --out runs/rollouts.jsonl.gz

    Then:  aicvds pretrain runs/rollouts.jsonl.gz --out runs/paper.pt

    Or:  aicvds pretrain runs/rollouts.jsonl.gz --features reach --epochs 10 --out runs/reach.pt

    Value regression as online, but of the discounted cost over several steps: the loss of a bad decision comes
    after it. The last tenth of the missions is held out, and its loss printed.
    """

    rollouts: Annotated[tyro.conf.Positional[Path], arg(metavar="FILE")]
    """What `aicvds explore` wrote."""
    out: Annotated[Path, arg(metavar="FILE")]
    """Checkpoint to write. The package's own are service/checkpoints/paper.pt and reach.pt, one a feature preset."""
    features: Features = "paper"
    """What the modules see: the paper's five numbers a sensor, or also what the trajectory brings in reach."""
    epochs: int = 3
    """Passes over the rollouts."""
    horizon: int = 8
    """Steps of cost that count for a decision; 1 is the paper's immediate cost."""
    discount: float = 0.9
    """Weight of each later step against the one before it."""
    ranking: float = 1.0
    """Weight of ranking the look-ahead policy's sensor and velocity first, against the value regression; 0 is none."""
    learning_rate: float = 2e-3
    """Adam's step size at the start; it falls to a tenth."""
    batch: int = 64
    """Decisions a step of Adam."""
    seed: int = 0
    """Of the initial weights and the order of the decisions."""


def main(argv: list[str]) -> int:
    """Train and write; returns the exit code."""
    args = tyro.cli(Pretrain, prog="aicvds pretrain", args=argv)
    console = Console()
    try:
        header, steps = read_rollouts(args.rollouts)
        with console.status("Replaying the rollouts through the edge's own features"):
            missions = list(replay(header, steps, args.horizon, args.discount, args.features))
        held_out = max(1, len(missions) // 10)
        train = [example for mission in missions[:-held_out] for example in mission]
        test = [example for mission in missions[-held_out:] for example in mission]
        if not train or not test:
            raise ValueError(f"{args.rollouts} holds {len(missions)} missions; at least 2 are needed")
        levels = header.scenario.max_velocity + 1
        modules = fit(Batch.of(train), Batch.of(test), levels, args, console)
        for k in (5, 3):
            console.print(f"held-out recall of the teacher's sensor in the top {k}: {recall(modules, test, k):.3f}")
        args.out.parent.mkdir(parents=True, exist_ok=True)
        save(modules, args.out)
    except (ValueError, OSError) as error:
        print(f"aicvds pretrain: {error}", file=sys.stderr)
        return 2
    console.print(f"Wrote {args.out}", soft_wrap=True)
    return 0


def recall(modules: Modules, examples: Iterable[Example], k: int) -> float:
    """How often the teacher's sensor is among the k best scored, of the decisions with more than k candidates."""
    hits = []
    for teacher in (example.teacher for example in examples if example.teacher is not None):
        if len(teacher.features) > k:
            hits.append(teacher.chosen in top_k(modules.score(teacher.features)[0], k))
    return sum(hits) / len(hits) if hits else float("nan")


def losses(modules: Modules, batch: Batch) -> tuple[Tensor, Tensor]:
    """Mean value regression, and mean cross-entropy that ranks the teacher's sensor and velocity first."""
    scores, z = modules.attention(batch.features, batch.admissible)
    everyone = torch.arange(len(batch))

    def values(choices: Choices) -> Tensor:
        u: Tensor = modules.velocity(z[everyone, choices.chosen], choices.approach)
        return u

    predicted = scores[everyone, batch.logged.chosen], values(batch.logged)[everyone, batch.logged.velocity]
    regression = sum(((guess - batch.reward) ** 2).mean() for guess in predicted)
    scores = scores.masked_fill(~batch.admissible, -torch.inf)
    sensor = functional.cross_entropy(scores, batch.teacher.chosen, reduction="none")
    velocity = functional.cross_entropy(values(batch.teacher), batch.teacher.velocity, reduction="none")
    return torch.as_tensor(regression), ((sensor + velocity) * batch.taught).mean()


def fit(train: Batch, test: Batch, levels: int, args: Pretrain, console: Console) -> Modules:
    """Minibatch Adam with a cosine schedule; prints the held-out loss after every epoch."""
    modules = Modules(args.features, levels, args.seed)
    adam = torch.optim.Adam(modules.parameters(), lr=args.learning_rate)
    batches = -(-len(train) // args.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, args.epochs * batches, args.learning_rate / 10)
    shuffle = torch.Generator().manual_seed(args.seed)
    mean = train.reward.mean()
    console.print(f"{len(train)} decisions, mean return {mean:.3f}; held out {len(test)}")
    console.print(f"held-out loss of the mean alone {2 * ((test.reward - mean) ** 2).mean():.4f}")
    with Progress(console=console) as progress:
        task = progress.add_task("Training", total=args.epochs * batches)
        for epoch in range(1, args.epochs + 1):
            for rows in torch.split(torch.randperm(len(train), generator=shuffle), args.batch):
                adam.zero_grad()
                regression, ranking = losses(modules, train[rows])
                (regression + args.ranking * ranking).backward()  # type: ignore[no-untyped-call]
                adam.step()
                schedule.step()
                progress.advance(task)
            with torch.inference_mode():
                regression, ranking = losses(modules, test)
            console.print(f"epoch {epoch}: held-out loss {regression:.4f}, of ranking {ranking:.4f}")
    return modules
