"""The declaration of experiments, and the flights that they need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from hashlib import sha256
from importlib.resources import files
from inspect import getfile
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lab.experiments.edges import Llm
from lab.experiments.flight import flight_key
from lab.experiments.result import Sweep
from lab.experiments.schemes import PLANNERS, Clairvoyant, Informed, Local, OverEdge, Scheme, local
from shared.kit.own_code import imported

if TYPE_CHECKING:
    from simulator.sites.site import Site

# With these, `all --quick` ends within 15 minutes on two cores, at three quarters of a second a decision of an LLM.
QUICK_STEPS = 3
QUICK_SEEDS, QUICK_LLM_SEEDS = 5, 2


@dataclass(frozen=True)
class Setup:
    """The options of the command line that apply to every experiment of a run.

    ``sites`` are the worlds by name; an experiment flies the first one, and those that it names. ``seeds`` and
    ``llm_seeds`` are numbers of seeds, from 0. ``steps`` are those of a mission, or ``None`` for the scenario's.
    ``only`` names the schemes to fly, or none for all. ``policies`` are the user's own, which fly too.
    """

    sites: dict[str, Site]
    llm: Llm = Llm()
    models: tuple[Path, ...] = ()
    seeds: int = 30
    llm_seeds: int = 10
    steps: int | None = None
    pace: Literal["full", "quick"] = "full"
    only: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()

    @property
    def quick(self) -> bool:
        """Whether missions with an LLM are shortened."""
        return self.pace == "quick"


@dataclass(frozen=True)
class FigureSpec:
    """One figure: its file's name, kind (see ``result.Figure``), measures, and the beginning of its caption."""

    name: str
    kind: Literal["curves", "bars", "sweep"]
    measures: tuple[str, ...]
    caption: str


@dataclass(frozen=True)
class Experiment:
    """The declaration of one figure or table of the paper, or of one beyond it.

    ``summary`` is its line in ``--help``. ``measures``, and the measures of curves in ``figures``, are names in
    ``measures.py``. Every other scheme is paired with each of ``references``; ``pairs`` are further pairs. With
    ``when_quick`` of ``short``, ``--quick`` shortens the missions of all schemes, so that they stay comparable; with
    ``no_llm`` it omits the schemes that query an LLM. ``worlds`` are the setup's sites that it flies besides the
    first one. On each site, the one of ``heuristics`` with the fewest lost packets is another reference for every other
    scheme.
    """

    name: str
    title: str
    summary: str
    schemes: Callable[[Setup], list[Scheme]]
    measures: tuple[str, ...]
    figures: tuple[FigureSpec, ...]
    references: tuple[str, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()
    paired_measures: tuple[str, ...] = ("lost_packets", "events")
    sweep: Sweep | None = None
    when_quick: Literal["short", "no_llm"] = "short"
    worlds: tuple[str, ...] = ()
    heuristics: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())

    def chosen(self, setup: Setup) -> list[Scheme]:
        """Its schemes, or those of them that the setup names, and the user's own policies."""
        named = [scheme for scheme in self.schemes(setup) if not setup.only or scheme.name in setup.only]
        return [*named, *map(local, setup.policies)]


@dataclass(frozen=True, eq=False)
class Planned:
    """One flight of a plan, flown already or not; flights with the same ``key`` are the same."""

    key: str
    scheme: Scheme
    site_name: str
    site: Site
    seed: int

    @property
    def backing(self) -> str | None:
        """The backing of the edge; ``None`` for a flight without an edge."""
        return self.scheme.decides.backing if isinstance(self.scheme.decides, OverEdge) else None

    @property
    def plans(self) -> bool:
        """Whether a planner flies it, which takes seconds, and a process of its own."""
        decides = self.scheme.decides
        return isinstance(decides, Clairvoyant | Informed) or (
            isinstance(decides, Local) and decides.policy in PLANNERS
        )


@dataclass(frozen=True, eq=False)
class ExperimentPlan:
    """An experiment's flights in display order, by scheme and then by site, and the schemes omitted."""

    experiment: Experiment
    flights: list[Planned]
    left_out: list[Scheme]


def plan(experiment: Experiment, setup: Setup) -> ExperimentPlan:
    """The flights that an experiment needs."""
    flights, left_out = [], []
    first = next(iter(setup.sites))
    sites = {name: site for name, site in setup.sites.items() if name == first or name in experiment.worlds}
    for scheme in experiment.chosen(setup):
        without_llm = setup.quick and experiment.when_quick == "no_llm"
        missing = isinstance(scheme.decides, OverEdge) and not setup.llm.flies(scheme.decides.backing)
        if scheme.asks_llm and (without_llm or missing):
            left_out.append(scheme)
            continue
        for name, site in sites.items():
            flown_at = _shortened(site, _steps(experiment, setup))
            for seed in range(setup.llm_seeds if scheme.asks_llm else setup.seeds):
                key = flight_key(scheme, _identity(scheme, setup), flown_at, seed)
                flights.append(Planned(key, scheme, name, flown_at, seed))
    return ExperimentPlan(experiment, flights, left_out)


def _identity(scheme: Scheme, setup: Setup) -> str | None:
    if isinstance(scheme.decides, OverEdge):
        return setup.llm.identity(scheme.decides.backing)
    if not isinstance(scheme.decides, Local):
        return None
    policy = scheme.decides.policy
    return _code_of(policy) if policy in setup.policies else weights_of(policy)


def _code_of(policy: str) -> str:
    """The hash of the file of a user's policy, so that a changed policy flies again."""
    return sha256(Path(getfile(imported(policy))).read_bytes()).hexdigest()[:16]


@cache
def weights_of(policy: str) -> str | None:
    """The hash of the trained network that ships for a policy; ``None`` for one that has none.

    As part of the flights' identity, it makes a newly trained scheme fly again.
    """
    file = files("lab.marl").joinpath("checkpoints", f"{policy.rpartition(':')[2]}.pt")
    return sha256(file.read_bytes()).hexdigest()[:16] if file.is_file() else None


def _steps(experiment: Experiment, setup: Setup) -> int | None:
    if setup.steps is not None:
        return setup.steps
    return QUICK_STEPS if setup.quick and experiment.when_quick == "short" else None


def _shortened(site: Site, steps: int | None) -> Site:
    if steps is None or steps >= site.scenario.steps:
        return site
    return replace(site, scenario=site.scenario.model_copy(update={"steps": steps}))
