"""``python -m lab pretrain``: initial weights of the attention and velocity modules, trained on recorded rollouts."""

from __future__ import annotations

import sys

import tyro
from rich.console import Console

from lab.training.options import Pretrain


def main(argv: list[str]) -> int:
    """Train and write; returns the exit code."""
    args = tyro.cli(Pretrain, prog="python -m lab pretrain", args=argv)
    console = Console()
    try:
        _check(args)
        # This import loads torch, which takes seconds; `--help` and usage errors answer without it.
        from lab.training.training_loop import pretrain

        pretrain(args, console)
    except (ValueError, OSError) as error:
        print(f"python -m lab pretrain: {error}", file=sys.stderr)
        return 2
    console.print(f"Wrote {args.out}", soft_wrap=True)
    return 0


def _check(args: Pretrain) -> None:
    if not args.rollouts:
        raise ValueError("name a file that python -m lab explore wrote, or several")
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
