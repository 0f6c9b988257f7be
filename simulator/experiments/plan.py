"""Experiments as declared, and the flights that they need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from simulator.experiments.edges import Llm
from simulator.experiments.flight import flight_key
from simulator.experiments.result import Sweep
from simulator.experiments.schemes import ASKED, PLANNER, Clairvoyant, Local, OverEdge, Scheme

if TYPE_CHECKING:
    from simulator.sites.site import Site

# So that `all --quick` ends within 15 minutes on two cores, an LLM's decision taking three quarters of a second.
QUICK_STEPS = 3
QUICK_SEEDS, QUICK_LLM_SEEDS = 5, 2


@dataclass(frozen=True)
class Setup:
    """What the command line says of every experiment of a run.

    ``sites`` are the worlds by name, the first the one that all but ``scenarios`` fly; ``seeds`` and ``llm_seeds``
    how many of each, from 0; ``steps`` of a mission, or the scenario's own.
    """

    sites: dict[str, Site]
    llm: Llm = Llm()
    models: tuple[Path, ...] = ()
    seeds: int = 30
    llm_seeds: int = 10
    steps: int | None = None
    pace: Literal["full", "quick"] = "full"

    @property
    def quick(self) -> bool:
        """Whether missions with an LLM are shortened."""
        return self.pace == "quick"


@dataclass(frozen=True)
class Drawing:
    """One figure: its file's name, kind (see ``result.Figure``), measures, and what the caption says first."""

    name: str
    kind: Literal["curves", "bars", "sweep"]
    measures: tuple[str, ...]
    caption: str


@dataclass(frozen=True)
class Experiment:
    """One figure or table, as its file declares it.

    ``summary`` is its line in ``--help``; ``measures`` and the curves among the drawings' measures are names in
    ``measures.py``; ``reference`` is the scheme that every other is paired to, ``pairs`` are further ones.
    ``when_quick`` says whether ``--quick`` shortens the missions of all schemes, so that they stay comparable, or
    leaves out those that ask an LLM. ``everywhere`` experiments fly all of the setup's sites.
    """

    name: str
    title: str
    summary: str
    schemes: Callable[[Setup], list[Scheme]]
    measures: tuple[str, ...]
    drawings: tuple[Drawing, ...]
    reference: str | None = None
    pairs: tuple[tuple[str, str], ...] = ()
    paired_measures: tuple[str, ...] = ("lost_packets", "events")
    sweep: Sweep | None = None
    when_quick: Literal["short", "no_llm"] = "short"
    where: Literal["first", "everywhere"] = "first"
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True, eq=False)
class Planned:
    """One flight to fly, or already flown: the same ``key``, the same flight."""

    key: str
    scheme: Scheme
    site_name: str
    site: Site
    seed: int

    @property
    def backing(self) -> str | None:
        """What must be behind the edge; ``None`` for a flight without an edge."""
        return self.scheme.decides.backing if isinstance(self.scheme.decides, OverEdge) else None

    @property
    def plans(self) -> bool:
        """Whether it runs OR-Tools, half a second a step."""
        decides = self.scheme.decides
        return isinstance(decides, Clairvoyant) or (isinstance(decides, Local) and decides.policy == PLANNER)


@dataclass(frozen=True, eq=False)
class Plan:
    """An experiment's flights, by scheme and then by site in the order to show them, and who was left out."""

    experiment: Experiment
    flights: list[Planned]
    left_out: list[Scheme]


def plan(experiment: Experiment, setup: Setup) -> Plan:
    """The flights that an experiment needs."""
    flights, left_out = [], []
    sites = dict(setup.sites) if experiment.where == "everywhere" else dict([next(iter(setup.sites.items()))])
    for scheme in experiment.schemes(setup):
        without_llm = setup.quick and experiment.when_quick == "no_llm"
        unasked = isinstance(scheme.decides, OverEdge) and scheme.decides.backing == ASKED and not setup.llm.there
        if scheme.asks_llm and (without_llm or unasked):
            left_out.append(scheme)
            continue
        for name, site in sites.items():
            flown_at = _shortened(site, _steps(experiment, setup))
            for seed in range(setup.llm_seeds if scheme.asks_llm else setup.seeds):
                key = flight_key(scheme, _identity(scheme, setup), flown_at, seed)
                flights.append(Planned(key, scheme, name, flown_at, seed))
    return Plan(experiment, flights, left_out)


def _identity(scheme: Scheme, setup: Setup) -> str | None:
    if isinstance(scheme.decides, OverEdge):
        return setup.llm.identity(scheme.decides.backing)
    return weights_of(scheme.decides.policy) if isinstance(scheme.decides, Local) else None


@cache
def weights_of(policy: str) -> str | None:
    """The hash of the trained network that ships for a policy; ``None`` for one that has none.

    A scheme trained anew is flown anew.
    """
    file = files("simulator").joinpath("checkpoints", f"{policy}.pt")
    return sha256(file.read_bytes()).hexdigest()[:16] if file.is_file() else None


def _steps(experiment: Experiment, setup: Setup) -> int | None:
    if setup.steps is not None:
        return setup.steps
    return QUICK_STEPS if setup.quick and experiment.when_quick == "short" else None


def _shortened(site: Site, steps: int | None) -> Site:
    if steps is None or steps >= site.scenario.steps:
        return site
    return replace(site, scenario=site.scenario.model_copy(update={"steps": steps}))
