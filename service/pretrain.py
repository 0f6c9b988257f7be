"""``aicvds pretrain``: the attention and velocity modules' start, learned from recorded rollouts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.progress import Progress, track
from rich.table import Table
from torch import Tensor
from torch.nn import functional
from tyro.conf import arg

from service.checkpoint import initial_weights, save
from service.examples import Batch, Choices, Example, Reward, Speed, Target, replay
from service.learner import Modules
from service.recall import recall, references, velocity_agreement, velocity_error
from shared.rollouts import read_rollouts
from shared.wire import Belief, Features


@dataclass(frozen=True)
class Pretrain:
    """Train the attention and velocity modules on recorded rollouts and write the checkpoint that missions start from.

    Record first:  aicvds explore --workers 2 --out runs/rollouts.jsonl.gz

    Then:  aicvds pretrain runs/rollouts.jsonl.gz --features reach --out runs/reach.pt

    Target `return`: value regression as online, but of the discounted cost over several steps, since the loss of a bad
    decision comes after it; and s_j and u_v shall rank the teacher's sensor and a velocity for it first (cross-entropy
    of their softmax).
    Target `immediate` is the paper's: regression of what this one step cost, and no teacher.

    Every eleventh mission is held out. On these are printed the loss, and beside random weights and the
    package's own checkpoint: how often each teacher's sensor is among the k best scored, and how near its velocity
    they come. The same command writes the same weights.
    """

    rollouts: Annotated[tyro.conf.Positional[Path], arg(metavar="FILE")]
    """What `aicvds explore` wrote."""
    out: Annotated[Path, arg(metavar="FILE")]
    """Checkpoint to write. The package's own are service/checkpoints/paper.pt and reach.pt, one a feature preset."""
    features: Features = "paper"
    """What the modules see: the paper's five numbers a sensor, or also what the trajectory brings in reach."""
    belief: Belief | None = None
    """What that is made from: `fleet`, all that the edge was told, or `reported`, what the UAV itself last heard.
    Default: reported for paper, fleet for reach, as missions have it."""
    target: Target = "return"
    """What they learn: the return over several steps and the teachers' ranking, or the paper's immediate cost."""
    epochs: int = 8
    """Passes over the rollouts."""
    horizon: int = 8
    """Steps of cost that count for a decision; target immediate has 1."""
    discount: float = 0.9
    """Weight of each later step against the one before it."""
    ranking: float = 1.0
    """Weight of the ranking against the value regression; 0 is none. Target immediate has none."""
    speed: Speed = "look_ahead"
    """The velocity that is ranked first: the best of one step of look-ahead for the teacher's sensor, or the teacher's
    own. A planner hovers or races as its whole plan asks; who learns that from one view hovers for good."""
    temperature: float = 0.05
    """Of the softmax that ranks: about the difference between good and bad values, so that they keep r's scale."""
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
    # More threads sum in another order, and are no faster with modules this small.
    torch.set_num_threads(1)
    try:
        _check(args)
        header, steps = read_rollouts(args.rollouts)
        reward = Reward(args.target, args.horizon, args.discount)
        replayed = replay(header, steps, reward, args.features, args.belief)
        missions = list(track(replayed, "Replaying the rollouts", header.missions, console=console))
        # Every eleventh: of teachers that take turns, each has its share.
        held_out = set(range(10, len(missions), 11)) or {len(missions) - 1}
        train = [example for n, mission in enumerate(missions) if n not in held_out for example in mission]
        test = [example for n in sorted(held_out) for example in missions[n]]
        if not train or not test:
            raise ValueError(f"{args.rollouts} holds {len(missions)} missions; at least 2 are needed")
        levels = header.scenario.max_velocity + 1
        modules = fit(Batch.of(train, args.speed), Batch.of(test, args.speed), levels, args, console)
        console.print(_report(modules, test, args, levels))
        args.out.parent.mkdir(parents=True, exist_ok=True)
        save(modules, args.out)
    except (ValueError, OSError) as error:
        print(f"aicvds pretrain: {error}", file=sys.stderr)
        return 2
    console.print(f"Wrote {args.out}", soft_wrap=True)
    return 0


def _check(args: Pretrain) -> None:
    for name in ("epochs", "horizon", "batch"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name} {getattr(args, name)} is not at least 1")
    for name in ("temperature", "learning_rate"):
        if not getattr(args, name) > 0:
            raise ValueError(f"--{name.replace('_', '-')} {getattr(args, name):g} is not above 0")
    if args.ranking < 0:
        raise ValueError(f"--ranking {args.ranking:g} is below 0")
    if not 0 <= args.discount <= 1:
        raise ValueError(f"--discount {args.discount:g} is not between 0 and 1")


def _report(modules: Modules, test: Sequence[Example], args: Pretrain, levels: int) -> Table:
    """Each teacher's held-out references against these modules, the shipped ones and random ones."""
    ranked = {"random": Modules(args.features, levels, args.seed).weights()}
    # There may be none yet, or of another shape: then this command makes the first.
    with suppress(OSError, RuntimeError):
        ranked["shipped"] = initial_weights("pretrained", args.features, levels, args.seed)
    ranked["trained"] = modules.weights()
    table = Table("held-out missions", *ranked, title=f"Features {args.features}, target {args.target}")
    for teacher, taught in references(test).items():
        for k in (1, 3, 5):
            table.add_row(
                f"{teacher}'s sensor in the top {k}", *(f"{recall(m, taught, k):.3f}" for m in ranked.values())
            )
        equal = (f"{velocity_agreement(m, taught):.3f}" for m in ranked.values())
        table.add_row(f"{teacher}'s velocity", *equal)
        off = (f"{velocity_error(m, taught):.1f} m/s" for m in ranked.values())
        table.add_row(f"mean difference from {teacher}'s velocity", *off)
    return table


def losses(modules: Modules, batch: Batch, temperature: float = 1.0) -> tuple[Tensor, Tensor]:
    """Mean value regression, and mean cross-entropy that ranks the teacher's sensor, and a velocity for it, first.

    ``(s_j - r)^2 + (u_v - r)^2`` of what was done; ``-ln softmax(s / temperature)_j* - ln softmax(u / temperature)_v*``
    of the reference j*, v*: the first (ListNet's top-one probability, Cao et al., ICML 2007, with one relevant sensor)
    only where j* can send something.
    """
    scores, z = modules.attention(batch.features, batch.admissible)
    everyone = torch.arange(len(batch))

    def values(choices: Choices) -> Tensor:
        u: Tensor = modules.velocity(z[everyone, choices.chosen], choices.approach)
        return u

    predicted = scores[everyone, batch.logged.chosen], values(batch.logged)[everyone, batch.logged.velocity]
    regression = sum(((guess - batch.reward) ** 2).mean() for guess in predicted)
    logits = scores.masked_fill(~batch.admissible, -torch.inf) / temperature
    sensor = functional.cross_entropy(logits, batch.teacher.chosen, reduction="none")
    velocity = functional.cross_entropy(values(batch.teacher) / temperature, batch.teacher.velocity, reduction="none")
    return torch.as_tensor(regression), (sensor * batch.reaches + velocity * batch.taught).mean()


def fit(train: Batch, test: Batch, levels: int, args: Pretrain, console: Console) -> Modules:
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
