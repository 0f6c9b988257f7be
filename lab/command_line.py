"""``python -m lab COMMAND``: the studies of the laboratory: experiments, training, and their records."""

from __future__ import annotations

import sys
from importlib import import_module

from shared.kit.validation_messages import suggestion

_COMMANDS = {
    "experiment": "reproduce a figure or table of the paper, or one beyond it, over many seeds",
    "explore": "record exploring UAVs on training worlds, for pretrain and distill",
    "pretrain": "train the attention and velocity modules' start on what explore recorded",
    "distill": "train the embedded LLM's adapter on what explore recorded",
    "distill-orders": "train the adapter that reads operators' notes",
    "train": "train the learned baselines, MADQN and MAPPO",
}


def usage() -> str:
    """The text of ``python -m lab --help``."""
    commands = "\n".join(f"  {name:<15} {text}" for name, text in _COMMANDS.items())
    return (
        f"usage: python -m lab COMMAND [OPTIONS]\n\n{commands}\n\n"
        "`python -m lab COMMAND --help` explains a command, its defaults and its units. It runs in a checkout."
    )


def main() -> int:
    """Run one command with the rest of the command line; returns the process's exit code."""
    name, rest = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 1 else ("--help", [])
    if name in ("--help", "-h"):
        print(usage())
        return 0
    if name not in _COMMANDS:
        print(f"python -m lab: unknown command {name!r}{suggestion(name, _COMMANDS)}\n\n{usage()}", file=sys.stderr)
        return 2
    try:
        return int(import_module(f"lab.commands.{name.replace('-', '_')}").main(rest) or 0)
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] in ("lab", "field", "service", "simulator", "shared"):
            raise
        print(f"python -m lab {name}: {missing.name} is not installed: pip install -e '.[lab]'", file=sys.stderr)
        return 2
