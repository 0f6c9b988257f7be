"""``python -m lab experiment``: make the paper's figures and tables, and those beyond it."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from rich.table import Table
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from lab.experiments.catalogue import ALL, EXPERIMENTS
from lab.experiments.edges import Llm
from lab.experiments.plan import QUICK_LLM_SEEDS, QUICK_SEEDS, Experiment, Setup
from lab.experiments.result import Result
from lab.scenario_changes import ScenarioChanges
from shared.kit.ray_connection import RayUnusable
from shared.kit.validation_messages import suggestion
from simulator.commands.options import check_between, edge_from_option, site_from_options
from simulator.commands.running import command_main
from simulator.errors import UsageError

SEEDS, LLM_SEEDS = 30, 10
PAGE, MAP, FIGURES = "page", "claims-map", "paper-figures"


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions(ScenarioChanges):  # noqa: D101
    __doc__ = f"""Make a figure or table of the paper, or one beyond it, over many worlds.

    NAME is one of these, or `{ALL}` for every one:

    {"    ".join(f"{name}: {experiment.summary}.{chr(10) * 2}" for name, experiment in EXPERIMENTS.items())}
    A scheme's mission in a world is stored in --out's flights/ and never flown twice: experiments share it, and the
    same command continues after Ctrl-C or a crash. The command starts the edges that it needs. Written to --out/NAME:
    results.json (means with 95% bootstrap intervals over seeds, comparisons paired by seed), results.csv (a line a
    scheme and seed, a column a measure), and the figures.

    Try it:  python -m lab experiment scheduler --quick

    Without an LLM, a minute:  python -m lab experiment fairness --llm none

    All results beside the paper's numbers, as a page:  python -m lab experiment {PAGE} --help

    A policy of your own beside the shipped ones:

        python -m lab experiment scheduler --llm none --policy mine.py:Mine --scheme eof --scheme wqcs

    Where the paper's claims hold, a map over its open numbers:  python -m lab experiment {MAP} --help

    The paper's figures as it draws them:  python -m lab experiment {FIGURES} --help

    Exit code: 0 made, 1 an edge or its LLM failed, 2 bad use, 130 interrupted.
    """

    name: Positional[Annotated[str, arg(metavar="NAME")]]
    """The experiment, or all."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/experiments")
    """Folder to write to, made if missing; its stored flights are used again."""
    quick: Annotated[bool, FlagCreatePairsOff] = False
    """Few seeds, and short missions with an LLM: a check that the figures can be made, without a valid result."""
    seeds: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Worlds for schemes without an LLM: seeds 0 to N - 1. Default: 30, quick 5."""
    llm_seeds: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Worlds for schemes with an LLM, a minute each. Default: 10, quick 2, at most --seeds."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Waypoints of a mission. Default: the world's own (30)."""
    llm: Annotated[str, arg(metavar="embedded|none|URL")] = "embedded"
    """The LLM: the embedded one, none (its schemes are left out), or an OpenAI-compatible server's address such as
    http://127.0.0.1:8080/v1 (AICVDS_LLM_MODEL and AICVDS_LLM_API_KEY apply to it)."""
    edge: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """Use this running edge for the schemes with an LLM, with its settings, instead of starting one."""
    model: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="FILE.gguf")] = ()
    """For llm-models: another model to embed; repeatable."""
    scenario: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The world: paper (default), stress, shadowed and others; `aicvds simulate --help` lists them."""
    world: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """A world of your own instead of a scenario: a folder, as for `aicvds simulate --world`."""
    scheme: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Fly this scheme alone, by its name in results.json; repeatable. Default: every scheme of the experiment."""
    policy: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="MODULE:CLASS")] = ()
    """Fly this policy of yours too, or FILE.py:CLASS, in the same worlds; repeatable (docs/guides/policy.md)."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Processes for the flights without an edge."""
    ray: Annotated[str | None, arg(metavar="local|HOST:PORT", help_behavior_hint="")] = None
    """Fly those as tasks of Ray: of one that starts here with --workers processes, or of a cluster with this machine in
    it (auto: the one that runs here). Needs the extra `ray`."""


def main(argv: list[str]) -> int:
    """Run ``python -m lab experiment``; returns the exit code."""
    if argv[:1] == [PAGE]:
        from lab.experiments import page

        return page.main(argv[1:])
    if argv[:1] == [MAP]:
        from lab.claims_map import command

        return command.main(argv[1:])
    if argv[:1] == [FIGURES]:
        from lab.paper_figures import command as drawn

        return drawn.main(argv[1:])
    return command_main(
        ExperimentOptions, "python -m lab experiment", argv, lambda options, console: experiment(options, argv, console)
    )


def experiment(options: ExperimentOptions, argv: list[str], console: Console) -> int:
    """Fly the missing flights, write, print; returns the exit code.

    Raises:
        UsageError: the options are unusable, the folder cannot be written, or there is no such Ray.
        EdgeError: an edge died, or lacks an LLM that it needs.
    """
    chosen = _chosen(options.name)
    setup = setup_of(options)
    _check_schemes(chosen, setup)
    from lab.experiments.runner import Run

    run = Run(setup, options.out, _commands(options.name, argv), console, options.workers, options.ray)
    try:
        results = run.make(chosen)
    except RayUnusable as error:
        raise UsageError(str(error)) from None
    except KeyboardInterrupt:
        console.print(f"interrupted; {run.flown} new flights are stored: the same command continues")
        raise
    for result in results:
        show(result, console)
    return 0


def setup_of(options: ExperimentOptions) -> Setup:
    """The setup from the options; raises ``UsageError`` for the first option out of bounds."""
    seeds = options.seeds if options.seeds is not None else QUICK_SEEDS if options.quick else SEEDS
    llm_seeds = options.llm_seeds if options.llm_seeds is not None else QUICK_LLM_SEEDS if options.quick else LLM_SEEDS
    check_between("--seeds", seeds, 1, 10_000)
    check_between("--llm-seeds", llm_seeds, 1, 10_000)
    check_between("--workers", options.workers, 1, 64)
    for model in options.model:
        if not model.is_file():
            raise UsageError(f"--model {model}: there is no such file")
    from simulator.policies.registry import policy_named

    for own in options.policy:
        if ":" not in own:
            raise UsageError(f"--policy {own}: write MODULE:CLASS or FILE.py:CLASS; --scheme names a shipped one")
        policy_named(own)
    if options.llm not in ("embedded", "none") and not options.llm.startswith(("http://", "https://")):
        raise UsageError(f"--llm {options.llm}: choose embedded, none, or a URL such as http://127.0.0.1:8080/v1")
    site = site_from_options(options.scenario, options.world, options.steps, options.changes)
    sites = {site.scenario.name: site}
    if options.scenario is None and not options.changes:
        named = dict.fromkeys(name for each in EXPERIMENTS.values() for name in each.worlds)
        sites |= {name: site_from_options(name, None, options.steps) for name in named if name not in sites}
    pace: Literal["full", "quick"] = "quick" if options.quick else "full"
    edge = None if options.edge is None else edge_from_option(options.edge)
    llm, llm_seeds = Llm(options.llm, edge), min(llm_seeds, seeds)
    return Setup(sites, llm, options.model, seeds, llm_seeds, options.steps, pace, options.scheme, options.policy)


def show(result: Result, console: Console) -> None:
    """Print each scheme's values of the experiment's first three measures, and the run's notes."""
    measures = list(dict.fromkeys(name for scheme in result.schemes.values() for name in scheme))[:3]
    table = Table("", *(result.labels[name] for name in measures), title=f"{result.title} ({result.experiment})")
    for name, found in result.schemes.items():
        seeds = len(result.seeds_of.get(name, result.seeds))
        cells = [f"{f.mean:.4g} [{f.low:.4g}, {f.high:.4g}]" if (f := found.get(m)) else "" for m in measures]
        table.add_row(f"{result.labels[name]} ({seeds})", *cells)
    if result.bound.keys() & set(measures):
        cells = [
            f"at least {f.mean:.4g} [{f.low:.4g}, {f.high:.4g}]" if (f := result.bound.get(m)) else "" for m in measures
        ]
        table.add_row("clairvoyant bound", *cells, style="italic")
    console.print(table)
    for note in result.notes:
        console.print(f"- {note}", markup=False, highlight=False)


def _chosen(name: str) -> list[Experiment]:
    if name == ALL:
        return list(EXPERIMENTS.values())
    if name not in EXPERIMENTS:
        raise UsageError(f"there is no experiment {name[:32]!r}: choose one of {', '.join(EXPERIMENTS)}, or {ALL}")
    return [EXPERIMENTS[name]]


def _check_schemes(chosen: list[Experiment], setup: Setup) -> None:
    known = list(dict.fromkeys(scheme.name for each in chosen for scheme in each.schemes(setup)))
    for name in setup.only:
        if name not in known:
            raise UsageError(f"--scheme: choose one of {', '.join(known)}, not {name[:32]!r}{suggestion(name, known)}")


def _commands(name: str, argv: list[str]) -> Callable[[Experiment], str]:
    """The command that makes one experiment, as its result names it: without the folder, which changes no number."""
    rest = list(argv)
    rest.remove(name)
    out = next((at for at, argument in enumerate(rest) if argument.partition("=")[0] == "--out"), None)
    if out is not None:
        del rest[out : out + (1 if "=" in rest[out] else 2)]
    return lambda experiment: shlex.join(["python", "-m", "lab", "experiment", experiment.name, *rest])
