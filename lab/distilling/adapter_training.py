"""LoRA training of the embedded model on examples."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from rich.console import Console
from rich.progress import Progress

from lab.distilling.batches import Batches
from lab.distilling.options import TrainingOptions
from shared.kit.cores import usable_cores

_WARM_UP_STEPS = 30
_MOST_GRADIENT = 1.0
CHECKPOINT_STEPS = 25
# Steps of the mean loss in the progress display, and from one log line to the next.
_RECENT = 50


class TrainingExample(Protocol):
    """A training example: the text that the student reads, and the expected answer."""

    @property
    def text(self) -> str:
        """The user message."""
        ...


E = TypeVar("E", bound=TrainingExample)
Read = TypeVar("Read", bound=TrainingExample, contravariant=True)


class AdapterStudent(Protocol[Read]):
    """A student that learns from one kind of example."""

    model: Any

    def loss(self, examples: Sequence[Read]) -> torch.Tensor:
        """The loss of a batch."""
        ...


def train(
    student: AdapterStudent[E], examples: Sequence[E], args: TrainingOptions, checkpoint: Path
) -> Generator[float, None, None]:
    """Train, and yield each step's loss; resumes from the checkpoint, which it writes every 25 steps.

    Raises:
        ValueError: the checkpoint is of another run.
    """
    batches = Batches([len(example.text) for example in examples], args.batch, args.seed)
    weights = [p for p in student.model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=args.learning_rate, weight_decay=0.0)
    first = 0
    if checkpoint.is_file():
        found = torch.load(checkpoint, weights_only=True)
        if found["run"] != _run(examples, args):
            raise ValueError(f"{checkpoint} is of a run with other examples or options: give --out another folder")
        first = found["step"]
        optimizer.load_state_dict(found["optimizer"])
        with torch.no_grad():
            for own, kept in zip(weights, found["weights"], strict=True):
                own.copy_(kept)
    student.model.train()
    for step in range(first, args.steps):
        for group in optimizer.param_groups:
            group["lr"] = args.learning_rate * _schedule(step, args.steps)
        loss = student.loss([examples[i] for i in batches.of(step)])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(weights, _MOST_GRADIENT)
        optimizer.step()
        if (step + 1) % CHECKPOINT_STEPS == 0 or step + 1 == args.steps:
            half = checkpoint.with_suffix(".part")
            kept = {
                "run": _run(examples, args),
                "step": step + 1,
                "optimizer": optimizer.state_dict(),
                "weights": [weight.detach().cpu() for weight in weights],
            }
            torch.save(kept, half)
            half.replace(checkpoint)
        yield float(loss.detach())


def prepared(args: TrainingOptions) -> str:
    """Set torch's threads and seed; returns the device."""
    torch.set_num_threads(args.threads or usable_cores())
    torch.manual_seed(args.seed)
    return args.device if args.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"


def train_showing(
    student: AdapterStudent[Any], training: Sequence[TrainingExample], args: TrainingOptions, console: Console
) -> None:
    """Train in the folder of the arguments, and show the progress; raises as :func:`train`."""
    with Progress(console=console) as progress:
        task = progress.add_task("Training", total=args.steps)
        recent: list[float] = []
        left = args.steps
        for loss in train(student, training, args, args.out / "checkpoint.pt"):
            recent = [*recent[1 - _RECENT :], loss]
            status = f"Training, loss {sum(recent) / len(recent):.3f}"
            progress.update(task, advance=1, description=status)
            left -= 1
            if left % _RECENT == 0 and not console.is_terminal:
                console.print(f"{args.steps - left} steps: {status}", highlight=False)
        progress.update(task, advance=left)


def _run(examples: Sequence[TrainingExample], args: TrainingOptions) -> str:
    """A text of all inputs that determine the weights of a run."""
    texts = hashlib.sha256("\n".join(example.text for example in examples).encode()).hexdigest()
    return f"{texts} {args.begin} {args.steps} {args.batch} {args.rank} {args.learning_rate} {args.seed}"


def _schedule(step: int, steps: int) -> float:
    """The share of the learning rate: linear warm-up, then a cosine to a tenth."""
    if step < _WARM_UP_STEPS:
        return (step + 1) / _WARM_UP_STEPS
    done = (step - _WARM_UP_STEPS) / max(1, steps - _WARM_UP_STEPS)
    return 0.1 + 0.45 * (1.0 + math.cos(math.pi * done))
