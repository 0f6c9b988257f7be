"""An experiment's paired comparisons: with its reference, its best heuristic, and the clairvoyant bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from lab.experiments.group import Group
from lab.experiments.intervals import interval, paired
from lab.experiments.measures import MEASURES
from lab.experiments.plan import Experiment
from lab.experiments.result import Interval, Paired
from lab.experiments.schemes import BOUND

# The reference that is another scheme on each site, and the measure that the bound is subtracted from.
BEST, EXCESS = "best_heuristic", "excess"
_LOST = "lost_packets"


@dataclass
class Comparisons:
    """Pairs of schemes on the same worlds, with the labels and notes that they need."""

    pairs: list[Paired] = field(default_factory=list)
    labels: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def comparisons(experiment: Experiment, flying: Sequence[Group], groups: Sequence[Group]) -> Comparisons:
    """All comparisons; each is of two schemes on one site, over the seeds that both flew.

    Args:
        flying: the schemes.
        groups: these, and the bound.
    """
    by_site = {(group.scheme.name, group.site): group for group in flying}
    names = [group.scheme.name for group in flying]
    pairs = [(name, reference) for reference in experiment.references for name in names if name != reference]
    found = Comparisons()
    for name, other in dict.fromkeys([*pairs, *experiment.pairs]):
        for site in dict.fromkeys(group.site for group in flying):
            if (name, site) in by_site and (other, site) in by_site:
                found.pairs += _pair(by_site[name, site], by_site[other, site], experiment.paired_measures)
    least = {group.site: _least(group) for group in groups if group.scheme.name == BOUND.name}
    _add_best(found, experiment, flying, least)
    for group in flying:
        found.pairs += _over_bound(group, least.get(group.site, {}))
    return found


def bounds(groups: Sequence[Group]) -> dict[str, Interval]:
    """The proven bound on each site, by the measures that it bounds."""
    found = {}
    for group in groups:
        if group.scheme.name == BOUND.name and (least := _least(group)):
            for name in (_LOST, "lost_packets_cumulative"):
                found[name + group.suffix] = interval(list(least.values()))
    return found


def _least(bound: Group) -> dict[int, float]:
    return {flight.seed: flight.bound.lower_bound for flight in bound.flights if flight.bound}


def _lost(group: Group) -> dict[int, float]:
    return {flight.seed: float(sum(flight.lost_packets)) for flight in group.flights}


def _pair(group: Group, other: Group, measures: Sequence[str], name: str | None = None) -> list[Paired]:
    theirs = {flight.seed: flight for flight in other.flights}
    both = [(flight, theirs[flight.seed]) for flight in group.flights if flight.seed in theirs]
    found: list[Paired] = []
    for measure in measures:
        values = [(MEASURES[measure].of(a), MEASURES[measure].of(b)) for a, b in both]
        present = [(a, b) for a, b in values if a is not None and b is not None]
        if present and len(present) == len(values):
            ours, others = zip(*present, strict=True)
            found += paired(group.scheme.name, name or other.scheme.name, measure + group.suffix, ours, others)
    return found


def _over_bound(group: Group, least: dict[int, float]) -> list[Paired]:
    ours = [(lost, least[seed]) for seed, lost in _lost(group).items() if seed in least]
    if not ours:
        return []
    return paired(group.scheme.name, BOUND.name, _LOST + group.suffix, *zip(*ours, strict=True))


def _add_best(
    found: Comparisons, experiment: Experiment, flying: Sequence[Group], least: dict[str, dict[int, float]]
) -> None:
    """Compare every scheme with the best heuristic of its site, and both less the bound."""
    best = {site: group for site in dict.fromkeys(g.site for g in flying) if (group := _best(experiment, flying, site))}
    if not best:
        return
    for group in flying:
        if group.site in best and group is not best[group.site]:
            found.pairs += _pair(group, best[group.site], (_LOST,), BEST)
            found.pairs += _excess(group, best[group.site], least.get(group.site, {}))
            found.labels[EXCESS + group.suffix] = "lost packets above the bound" + f", {group.site}" * bool(
                group.suffix
            )
    found.labels[BEST] = "the best heuristic"
    named = "; ".join(f"{group.scheme.label} on {site}" for site, group in best.items())
    found.notes.append(
        f"The best heuristic is the one that loses the fewest packets over these seeds: {named}. It is chosen by the "
        "same missions that it is compared on, which favours it."
    )


def _best(experiment: Experiment, flying: Sequence[Group], site: str) -> Group | None:
    there = [group for group in flying if group.site == site and group.scheme.name in experiment.heuristics]
    return min(there, key=lambda group: sum(_lost(group).values()) / len(group.flights), default=None)


def _excess(group: Group, best: Group, least: dict[int, float]) -> list[Paired]:
    """The ratio of the losses above the bound; their difference is that of the losses."""
    ours, theirs = _lost(group), _lost(best)
    seeds = [seed for seed in ours if seed in theirs and seed in least]
    if not seeds:
        return []
    above = ([lost[seed] - least[seed] for seed in seeds] for lost in (ours, theirs))
    whole = paired(group.scheme.name, BEST, EXCESS + group.suffix, *above)
    return [pair for pair in whole if pair.kind == "ratio"]
