"""``aicvds pretrain``: the attention and velocity modules' start, learned from recorded rollouts."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
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
from service.features import FEATURES
from service.learner import Modules, Sample
from service.mission import Mission
from service.policy import decide_without_llm
from service.settings import Settings
from service.view import View
from shared.rollouts import Header, RolloutStep, read_rollouts
from shared.scenario import Scenario
from shared.wire import MissionSpec, Outcome


@dataclass(frozen=True)
class Pretrain:
    """Train the attention and velocity modules on recorded rollouts and write the checkpoint that missions start from.

    Record first:  aicvds explore --out runs/rollouts.jsonl.gz
    Then:          aicvds pretrain runs/rollouts.jsonl.gz --out runs/paper.pt

    Value regression as online, but of the discounted cost over several steps: the loss of a bad decision comes
    after it. The last tenth of the missions is held out, and its loss printed.
    """

    rollouts: Annotated[tyro.conf.Positional[Path], arg(metavar="FILE")]
    """What `aicvds explore` wrote."""
    out: Annotated[Path, arg(metavar="FILE")]
    """Checkpoint to write. The package's own is service/checkpoints/paper.pt."""
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


@dataclass(frozen=True, slots=True)
class Example:
    """A decision as the modules saw it, the return that followed (minus the discounted cost), and the teacher's.

    ``teacher`` is what the look-ahead policy would have decided from the same view; None where its sensor was masked.
    """

    sample: Sample
    reward: float
    teacher: Sample | None


def main(argv: list[str]) -> int:
    """Train and write; returns the exit code."""
    args = tyro.cli(Pretrain, prog="aicvds pretrain", args=argv)
    console = Console()
    try:
        header, steps = read_rollouts(args.rollouts)
        with console.status("Replaying the rollouts through the edge's own features"):
            missions = list(replay(header, steps, args.horizon, args.discount))
        held_out = max(1, len(missions) // 10)
        train = [example for mission in missions[:-held_out] for example in mission]
        test = [example for mission in missions[-held_out:] for example in mission]
        if not train or not test:
            raise ValueError(f"{args.rollouts} holds {len(missions)} missions; at least 2 are needed")
        modules = fit(train, test, header.scenario.max_velocity + 1, args, console)
        for k in (5, 3):
            console.print(f"held-out recall of the teacher's sensor in the top {k}: {recall(modules, test, k):.3f}")
        args.out.parent.mkdir(parents=True, exist_ok=True)
        torch.save(modules.state_dict(), args.out)
    except (ValueError, OSError) as error:
        print(f"aicvds pretrain: {error}", file=sys.stderr)
        return 2
    console.print(f"Wrote {args.out}", soft_wrap=True)
    return 0


def replay(header: Header, steps: Iterable[RolloutStep], horizon: int, discount: float) -> Iterator[list[Example]]:
    """Each mission's examples, by the same visiting records, arrival rates and features as online."""
    settings = Settings(mode="value")
    for mission_id, group in groupby(steps, key=lambda step: step.request.mission_id):
        logged = list(group)
        costs: dict[int, list[float]] = {}
        for step in logged:
            costs.setdefault(step.request.uav_id, []).append(fleet_cost(step, header.scenario))
        mission = Mission(mission_id, MissionSpec(scenario=header.scenario, init="random"), settings)
        examples, turn = [], dict.fromkeys(costs, 0)
        for number, step in enumerate(logged):
            uav, decision_id = step.request.uav_id, f"{number:032x}"
            mission.observe(step.request)
            view = View.of(mission, step.request, step.request.step)
            view.attend(mission)
            reserved = mission.reserved(view.step, uav)
            sensor, velocity = decide_without_llm(view.state, uav, mission.scenario, reserved)
            teacher = view.pending(mission, decision_id, sensor, velocity).sample
            mission.commit(view.pending(mission, decision_id, step.sensor_id, step.velocity))
            sample = mission.apply(Outcome(decision_id=decision_id, cost=step.cost, failed=step.failed))
            ahead = costs[uav][turn[uav] : turn[uav] + horizon]
            turn[uav] += 1
            if sample is not None and len(ahead) == horizon:
                weights = [discount**n for n in range(horizon)]
                reward = -sum(w * c for w, c in zip(weights, ahead, strict=True)) / sum(weights)
                examples.append(Example(sample, reward, teacher))
        yield examples


def recall(modules: Modules, examples: Iterable[Example], k: int) -> float:
    """How often the teacher's sensor is among the k best scored, of the decisions with more than k candidates."""
    hits = []
    for teacher in (example.teacher for example in examples if example.teacher is not None):
        if len(teacher.features) > k:
            hits.append(teacher.chosen in top_k(modules.score(teacher.features)[0], k))
    return sum(hits) / len(hits) if hits else float("nan")


def _loss(modules: Modules, example: Example, ranking: float) -> Tensor:
    """Value regression, and cross-entropy that ranks the teacher's sensor and velocity first."""
    loss = modules.loss(example.sample, example.reward)
    if example.teacher is None or ranking == 0:
        return loss
    scores, values = modules.evaluate(example.teacher)
    sensor = functional.cross_entropy(scores, torch.tensor(example.teacher.chosen))
    velocity = functional.cross_entropy(values, torch.tensor(example.teacher.velocity))
    return loss + ranking * (sensor + velocity)


def fleet_cost(step: RolloutStep, scenario: Scenario) -> float:
    """``f + lost / (W I)``: a UAV's failure and its share of all that the fleet lost in the step.

    Its own c would teach it to hover: what overflows out of its reach costs it nothing.
    """
    return float(step.failed) + step.fleet_lost / (scenario.queue_capacity * scenario.uavs)


def fit(train: list[Example], test: list[Example], levels: int, args: Pretrain, console: Console) -> Modules:
    """Minibatch Adam with a cosine schedule; prints the held-out loss after every epoch."""
    modules = Modules(FEATURES, levels, args.seed)
    adam = torch.optim.Adam(modules.parameters(), lr=args.learning_rate)
    batches = -(-len(train) // args.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, args.epochs * batches, args.learning_rate / 10)
    shuffle = torch.Generator().manual_seed(args.seed)
    mean = sum(e.reward for e in train) / len(train)
    console.print(f"{len(train)} decisions, mean return {mean:.3f}; held out {len(test)}")
    console.print(f"held-out loss of the mean alone {2 * sum((e.reward - mean) ** 2 for e in test) / len(test):.4f}")
    with Progress(console=console) as progress:
        task = progress.add_task("Training", total=args.epochs * batches)
        for epoch in range(1, args.epochs + 1):
            order = torch.randperm(len(train), generator=shuffle).tolist()
            for start in range(0, len(order), args.batch):
                chosen = [train[i] for i in order[start : start + args.batch]]
                adam.zero_grad()
                loss = torch.stack([_loss(modules, e, args.ranking) for e in chosen]).mean()
                loss.backward()  # type: ignore[no-untyped-call]
                adam.step()
                schedule.step()
                progress.advance(task)
            with torch.inference_mode():
                held_out = sum(modules.loss(e.sample, e.reward).item() for e in test) / len(test)
            console.print(f"epoch {epoch}: held-out loss {held_out:.4f}")
    return modules
