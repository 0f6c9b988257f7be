"""``python -m lab distill``: a LoRA adapter of the embedded LLM, trained on recorded rollouts."""

from __future__ import annotations

import sys

import tyro
from rich.console import Console

from lab.distilling.options import Distill, DistillOrders, TrainingOptions
from service.llm.model_file import ModelMissing


def main(argv: list[str]) -> int:
    """Train and write; returns the exit code."""
    return trained(Distill, "distill", argv)


def trained(options: type[TrainingOptions], name: str, argv: list[str]) -> int:
    """Train by a command's options and write; returns the exit code."""
    args = tyro.cli(options, prog=f"python -m lab {name}", args=argv)
    console = Console()
    try:
        _check(args)
        # These imports load torch and transformers, which takes seconds; `--help` and usage errors answer without them.
        if isinstance(args, Distill):
            from lab.distilling.distill import distill

            distill(args, console)
        elif isinstance(args, DistillOrders):
            from lab.distilling.distill_orders import distill_orders

            distill_orders(args, console)
    except (ValueError, OSError, ModelMissing) as error:
        print(f"python -m lab {name}: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as missing:
        print(f"python -m lab {name}: {missing.name} is not installed: pip install -e '.[lab]'", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"python -m lab {name}: interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        return 130
    console.print(f"Wrote {args.out / 'adapter.gguf'}", soft_wrap=True)
    return 0


def _check(args: TrainingOptions) -> None:
    if isinstance(args, Distill) and not args.rollouts and args.begin is None:
        raise ValueError("name at least one file of `python -m lab explore`, or an adapter with --begin")
    for name in ("steps", "batch", "workers"):
        if getattr(args, name, 1) < 1:
            raise ValueError(f"--{name} {getattr(args, name)} is not at least 1")
    if not 1 <= args.rank <= 64:
        raise ValueError(f"--rank {args.rank} is not between 1 and 64")
    if not args.learning_rate > 0:
        raise ValueError(f"--learning-rate {args.learning_rate:g} is not above 0")
    if args.threads < 0:
        raise ValueError(f"--threads {args.threads} is below 0")
