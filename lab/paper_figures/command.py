"""``python -m lab experiment paper-figures``: the paper's figures as it draws them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, UseAppendAction, arg

from lab.scenario_changes import ScenarioChanges
from shared.world.scenario import Scenario
from simulator.commands.options import check_between, scenario_from_options
from simulator.commands.running import command_main
from simulator.records.run_folder import naming_out

FigureName = Literal["losses", "attention", "top-k", "tokens", "round-trips", "visits"]
# The paper's numbers of runs, and of steps where they are not the mission's 30.
RUNS, QUICK_RUNS, ATTENTION_RUNS, ATTENTION_STEPS, TRIP_RUNS = 10, 3, 5, 20, 5


@dataclass(frozen=True, kw_only=True)
class FigureOptions(ScenarioChanges):
    """Draw the paper's figures as it draws them, with at most five curves, and write their numbers as CSV.

    Look-ahead stands in the LLM's place behind attention; only the round trips ask an LLM. losses: lost packets by step
    of the paper's five schemes. attention: on and off, 20 steps, 5 runs. top-k: k of 3, 5, 7 and all from a random
    start. tokens: of the state block by step, with one standard deviation. round-trips: on each UAV's circle, and how
    much of their variance the place explains. visits: Jain's index by run and visits by sensor.

    Try it:  python -m lab experiment paper-figures --quick

    Exit code: 0 drawn, 1 the edge of the round trips failed, 2 bad use, 130 interrupted.
    """

    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/paper-figures")
    """Folder to write to, made if missing."""
    figure: Annotated[UseAppendAction[tuple[FigureName, ...]], arg(metavar="NAME")] = ()
    """Draw this one alone: losses, attention, top-k, tokens, round-trips or visits; repeatable. Default: all."""
    scenario: Annotated[str, arg(metavar="NAME")] = "paper"
    """The world."""
    runs: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Runs of losses, top-k, tokens and visits. Default: 10 as in the paper, quick 3."""
    llm: Literal["embedded", "none"] = "embedded"
    """What answers the round trips: the embedded LLM with its adapter, or mode `value`."""
    quick: Annotated[bool, FlagCreatePairsOff] = False
    """Three runs, and one mission of 20 steps for the round trips: each figure in under a minute."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab experiment paper-figures``; returns the exit code."""
    return command_main(FigureOptions, "python -m lab experiment paper-figures", argv, paper_figures)


def paper_figures(options: FigureOptions, console: Console) -> int:
    """Fly, draw, write; returns the exit code.

    Raises:
        UsageError: an option is out of bounds, or the folder cannot be written.
        EdgeError: the edge of the round trips died, or lacks its LLM.
    """
    scenario = scenario_from_options(options.scenario, changes=options.changes)
    runs = options.runs if options.runs is not None else QUICK_RUNS if options.quick else RUNS
    check_between("--runs", runs, 2, 1000)
    # Torch, numba and matplotlib take seconds to import.
    from lab.claims_map.flights import chooser_name, fly
    from lab.paper_figures import drawing, measured

    def curves(name: str, looks: drawing.Looks, world: Scenario, count: int) -> None:
        flights = {scheme: fly(scheme, world, range(count)) for scheme, _, _ in looks.values()}
        drawing.losses(folder, name, looks, flights)

    def trips() -> None:
        seeds, world = range(1 if options.quick else TRIP_RUNS), short if options.quick else scenario
        found = measured.round_trips(world, seeds, options.llm != "none", console)
        drawing.circles(folder, "round-trips", scenario, found)
        share, chance = measured.spatial_share(found, scenario.lap_centres)
        console.print(f"the place explains {share:.2f} of the round trips' variance, by chance p = {chance:.3f}")

    short = scenario.model_copy(update={"steps": min(ATTENTION_STEPS, scenario.steps)})
    draws: dict[FigureName, Callable[[], None]] = {
        "losses": lambda: curves("losses", drawing.FIVE, scenario, runs),
        "attention": lambda: curves("attention", drawing.ON_OFF, short, ATTENTION_RUNS),
        "top-k": lambda: curves("top-k", drawing.BY_K, scenario, runs),
        "tokens": lambda: drawing.tokens(folder, "tokens", *measured.tokens_by_step(scenario, range(runs))),
        "round-trips": trips,
        "visits": lambda: drawing.visits(folder, "visits", fly(chooser_name("shipped", 5), scenario, range(runs))),
    }
    with naming_out(options.out):
        folder = drawing.Folder(options.out)
        for name in options.figure or draws:
            draws[name]()
            console.print(f"Wrote {options.out / name}.svg and .csv", markup=False, highlight=False)
    return 0
