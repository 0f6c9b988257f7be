"""``python -m lab experiment claims-map``: where the paper's claims hold, over the numbers that it leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, arg

from simulator.commands.options import check_between
from simulator.commands.running import command_main
from simulator.errors import UsageError
from simulator.records.run_folder import naming_out

SEEDS, QUICK_SEEDS = 30, 2


@dataclass(frozen=True)
class MapOptions:
    """Map where the paper's claims hold: 52 settings of arrivals, initial queues, step, threshold and link share.

    Every setting is flown by the paper's EOF, WQCS and MADQN, by our MADQN and MAPPO, all with the shipped weights, by
    mode `value`, and by one step of look-ahead in the LLM's place behind attention (k of 3, 5, 7 and all sensors; from
    the shipped and from a random start). One process takes some 20 minutes. Each scheme's flights at a setting are a
    file of --out, and the same command continues after Ctrl-C or a crash. Written to --out: claims-map.csv (a line a
    setting and claim), claims-map-curves.csv (a line a setting and scheme), and the figure.

    Try it:  python -m lab experiment claims-map --quick

    Exit code: 0 made, 2 bad use, 130 interrupted.
    """

    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/claims-map")
    """Folder to write to, made if missing; its stored flights are used again."""
    quick: Annotated[bool, FlagCreatePairsOff] = False
    """Four settings and two worlds, in under a minute: a check that the map can be made, without a valid result."""
    written: Annotated[bool, FlagCreatePairsOff] = False
    """Fly nothing: judge and write the settings that are complete."""
    seeds: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Worlds of each setting: seeds 0 to N - 1. Default: 30, quick 2."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab experiment claims-map``; returns the exit code."""
    return command_main(MapOptions, "python -m lab experiment claims-map", argv, claims_map)


def claims_map(options: MapOptions, console: Console) -> int:
    """Fly the missing flights, judge and write; returns the exit code.

    Raises:
        UsageError: an option is out of bounds, or the folder cannot be written.
    """
    seeds = options.seeds if options.seeds is not None else QUICK_SEEDS if options.quick else SEEDS
    check_between("--seeds", seeds, 2, 1000)
    # Torch and numba take seconds to import; `--help` and usage errors do without them.
    from lab.claims_map.flights import SCHEMES, Flown, flights_file, fly_all
    from lab.claims_map.judging import judge
    from lab.claims_map.points import points
    from lab.claims_map.writing import CURVES, FIGURE, VERDICTS, draw, write_curves, write_verdicts

    folder, settings, complete = options.out / "flights", points(options.quick), []
    with naming_out(options.out):
        if options.written:
            complete = [
                p for p in settings if all(flights_file(folder, p, scheme, seeds).exists() for scheme in SCHEMES)
            ]
        else:
            complete = list(fly_all(settings, seeds, folder, console))
        if not complete:
            raise UsageError(f"--written: {folder} has no setting with every scheme's flights in {seeds} worlds")
        flights = [{s: Flown.load(flights_file(folder, point, s, seeds)) for s in SCHEMES} for point in complete]
        judged = [(point, judge(flown)) for point, flown in zip(complete, flights, strict=True)]
        write_verdicts(options.out / VERDICTS, judged, seeds)
        write_curves(options.out / CURVES, complete, flights)
        draw(options.out, judged, seeds)
    console.print(f"Wrote {VERDICTS}, {CURVES} and {FIGURE}.svg in {options.out}", markup=False, highlight=False)
    return 0
