"""``python -m lab train``: train a learned baseline, MADQN or MAPPO."""

from __future__ import annotations

import logging
import shlex
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tyro.conf import FlagCreatePairsOff, Positional, arg

from lab.marl.plan import MOST_EPISODES, STATE, TrainingPlan
from lab.scenario_changes import ScenarioChanges
from shared.world.scenario import Scenario
from simulator.commands.options import check_between, check_seed, scenario_from_options
from simulator.commands.running import command_main
from simulator.errors import INTERRUPTED, UsageError
from simulator.records.run_folder import naming_out

# Torch and TorchRL take seconds to import; `--help` and usage errors do without them.
if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.marl.training import MarlScheme, Round, Training

_EXTRA = "Install the extra: pip install -e '.[lab]'"


@dataclass(frozen=True, kw_only=True)
class Train(ScenarioChanges):
    """Train a learned baseline: MADQN or MAPPO.

    MADQN: independent deep Q-learning with one network for all UAVs, 1000 episodes. MAPPO: actors with a centralised
    critic, 21600 episodes. `madqn_paper`: the paper's MADQN, a network for each UAV on its plain state, 1000 episodes.
    All with the paper's table of hyperparameters; about ten minutes each. Written to --out: SCHEME.pt (the
    weights for `--policy`), SCHEME.csv and .png and .svg (the learning curve), tensorboard/, state.pt.

    The checkpoints that ship with the package were made by

      python -m lab train madqn --out runs/madqn

      python -m lab train mappo --out runs/mappo

      python -m lab train madqn_paper --out runs/madqn_paper

    Watch a training with `tensorboard --logdir runs`. After Ctrl-C or a crash, the same command with --resume continues
    the training, and its weights equal those of an uninterrupted one. The same options give the same weights to the bit
    on the same machine. Training worlds are apart from every evaluation seed.

    Exit code: 0 trained, 2 bad use, 130 interrupted.
    """

    scheme: Positional[Literal["madqn", "mappo", "madqn_paper"]]
    """The scheme to train."""
    scenario: Annotated[str, arg(metavar="NAME")] = "paper"
    """The training's world. Weights fit only scenarios with the same numbers of sensors, UAVs and velocities."""
    episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Missions to fly. Default: 1000 for either madqn, as in the paper, 21600 for mappo."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the initial weights, the exploration and the training worlds, 0 to 4294967295."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder to write to, made if missing. Default: runs/ and the scheme, such as runs/madqn."""
    resume: Annotated[bool, FlagCreatePairsOff] = False
    """Continue the training in --out."""
    threads: Annotated[int, arg(metavar="N")] = 1
    """Threads of torch, 1 to 64. Other numbers round differently, so they give other weights."""
    save_s: Annotated[float, arg(metavar="S")] = 30.0
    """Seconds between saved states for --resume, 0 to 3600; 0 saves after every round of missions."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab train``; returns the exit code."""
    # A resumed training makes the same weights, so its recorded command omits the option.
    command = shlex.join(["python", "-m", "lab", "train", *(argument for argument in argv if argument != "--resume")])
    return command_main(Train, "python -m lab train", argv, lambda options, console: train(options, command, console))


def train(options: Train, command: str, console: Console) -> int:
    """Train, write, print; returns the exit code.

    Raises:
        UsageError: the options are unusable, the folder has another training, or the extra ``marl`` is not installed.
    """
    scenario = scenario_from_options(options.scenario, changes=options.changes)
    check(options)
    out = options.out or Path("runs") / options.scheme
    if (out / STATE).exists() and not options.resume:
        raise UsageError(f"--out {out} has a training: give --resume to continue it, or another --out")
    with console.status("Loading TorchRL"):
        learner, plan = _planned(options, scenario)
        from lab.marl.training import Training

    # TorchRL logs every replay buffer at level INFO.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    training = Training(plan, learner, out)
    if options.resume:
        training.resume()
    try:
        with naming_out(out):
            out.mkdir(parents=True, exist_ok=True)
            _run(training, options, console)
            _conclude(training, command, out, console)
    except KeyboardInterrupt:
        console.print(f"Interrupted at episode {training.episodes}. The same command with --resume continues.")
        return INTERRUPTED
    return 0


def check(options: Train) -> None:
    """Raises ``UsageError`` for the first option out of bounds."""
    if options.episodes is not None:
        check_between("--episodes", options.episodes, 1, MOST_EPISODES)
    check_seed(options.seed)
    check_between("--threads", options.threads, 1, 64)
    check_between("--save-s", options.save_s, 0, 3600)


def _planned(options: Train, scenario: Scenario) -> tuple[Callable[[Scenario, int, int], MarlScheme], TrainingPlan]:
    try:
        from lab.marl import madqn, mappo, paper_madqn
    except ModuleNotFoundError as missing:
        raise UsageError(f"{missing.name} is not installed. {_EXTRA}") from None

    learners: dict[str, Callable[[Scenario, int, int], MarlScheme]] = {
        learner.name: learner for learner in (madqn.Madqn, mappo.Mappo, paper_madqn.PaperMadqn)
    }
    learner = learners[options.scheme]
    episodes = mappo.EPISODES if options.scheme == "mappo" else madqn.EPISODES
    chosen = episodes if options.episodes is None else options.episodes
    return learner, TrainingPlan(options.scheme, scenario, chosen, options.seed, options.threads)


def _run(training: Training, options: Train, console: Console) -> None:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=8),
        MofNCompleteColumn(),
        TextColumn("missions"),
        TextColumn("{task.fields[results]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(
            options.scheme.upper(), total=training.plan.episodes, completed=training.episodes, results=""
        )

        def on_round(flown: Round) -> None:
            results = f"loss {flown.loss:.3f}, lost {flown.lost_packets:.0f}"
            progress.update(task, completed=training.episodes, results=results)

        training.run(on_round, options.save_s)


def _conclude(training: Training, command: str, out: Path, console: Console) -> None:
    from lab.marl.checkpoint import PolicyCheckpoint
    from lab.marl.curve import plot, write_csv

    plan = training.plan
    weights = {name: value.clone() for name, value in training.learner.network.state_dict().items()}
    trained = PolicyCheckpoint(
        plan.scheme, plan.scenario, plan.episodes, plan.seed, command, version("aic-vds"), weights
    )
    trained.save(out / f"{plan.scheme}.pt")
    write_csv(training.points, out / f"{plan.scheme}.csv")
    plot(training.points, f"{plan.scheme.upper()} in scenario {plan.scenario.name}", out / plan.scheme)
    last = training.points[-1].greedy_lost_packets
    console.print(f"{last:.0f} packets lost a mission on held-out worlds without exploration", highlight=False)
    for suffix in (".pt", ".csv", ".png", ".svg"):
        console.print(f"Wrote {out / plan.scheme}{suffix}", markup=False, highlight=False, soft_wrap=True)
