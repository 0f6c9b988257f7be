"""``python -m lab demonstrate``: choose worked examples for the prompt from rollouts, each solved by a teacher."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from tyro.conf import arg

from lab.exploration.rollouts import read_rollouts


@dataclass(frozen=True)
class Demonstrate:
    """Choose the worked examples that a prompt may show (prompt.demonstrations), and write them as JSON.

    Record first:  python -m lab explore --workers 2 --out runs/rollouts.jsonl.gz

    Then:  python -m lab demonstrate runs/rollouts.jsonl.gz --out service/checkpoints/demonstrations.json

    The teacher answers every recorded decision with a choice of sensors and something in reach. The decision in the
    middle of all states comes first, then always the one farthest from those chosen, so that the first few differ most.
    """

    rollouts: Annotated[tyro.conf.Positional[Path], arg(metavar="FILE")]
    """What `python -m lab explore` wrote."""
    out: Annotated[Path, arg(metavar="FILE")]
    """JSON file to write. The package's own is service/checkpoints/demonstrations.json."""
    count: Annotated[int, arg(metavar="N")] = 40
    """Decisions to choose. A mission shows at most 20, and leaves out decisions whose answer it could not give."""
    teacher: Annotated[str, arg(metavar="NAME")] = "planner"
    """The teacher: planner or clairvoyant, as recorded, or look_ahead, one step of look-ahead.
    A clairvoyant acts on arrivals that are unknown at the decision."""


def main(argv: list[str]) -> int:
    """Choose and write; returns the exit code."""
    args = tyro.cli(Demonstrate, prog="python -m lab demonstrate", args=argv)
    # These imports load torch, which takes seconds; `--help` answers without them.
    from lab.training.demonstration_teachers import TEACHERS, farthest_first, solutions
    from service.prompting.demonstrations import Demonstrations

    try:
        if args.teacher not in TEACHERS:
            raise ValueError(f"--teacher {args.teacher}: choose one of {', '.join(TEACHERS)}")
        if args.count < 1:
            raise ValueError(f"--count {args.count} is not at least 1")
        header, steps = read_rollouts(args.rollouts)
        total = header.missions * header.scenario.steps * header.scenario.uavs
        tracked = track(steps, total=total, description="Solving", console=Console(stderr=True))
        demonstrations, states = [], []
        for demonstration, state in solutions(header, tracked, TEACHERS[args.teacher]):
            demonstrations.append(demonstration)
            states.append(state)
        if not states:
            fix = "record with python -m lab explore --teacher both"
            raise ValueError(f"{args.rollouts} has no decision of {args.teacher}: {fix}")
        if len(states) < args.count:
            raise ValueError(
                f"{args.rollouts} has {len(states)} decisions with a choice; --count asks for {args.count}"
            )
        chosen = [demonstrations[i] for i in farthest_first(np.stack(states), args.count)]
        args.out.parent.mkdir(parents=True, exist_ok=True)
        pool = Demonstrations(scenario=header.scenario, teacher=args.teacher, demonstrations=chosen)
        args.out.write_text(pool.model_dump_json(exclude_defaults=True) + "\n", encoding="utf-8")
    except (ValueError, OSError) as error:
        print(f"python -m lab demonstrate: {error}", file=sys.stderr)
        return 2
    print(f"Wrote {args.out}: {args.count} of {len(states)} decisions, {args.out.stat().st_size} bytes")
    return 0
