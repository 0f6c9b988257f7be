"""From an experiment's flights to its ``results.json`` and ``results.csv``."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from importlib.metadata import version
from io import StringIO

from lab.experiments.comparisons import bounds, comparisons
from lab.experiments.flight import FlightRecord
from lab.experiments.group import Group, groups_of
from lab.experiments.intervals import METHOD, curve, interval
from lab.experiments.measures import MEASURES, STEP_MEASURES, substituted_decisions
from lab.experiments.plan import Experiment, ExperimentPlan, FigureSpec, Setup
from lab.experiments.result import Curve, Figure, Interval, Result
from lab.experiments.schemes import BOUND, OverEdge
from simulator.errors import UsageError

# The largest share of substituted decisions without a note: a few late answers belong to the LLM, more of them make the
# result another method's.
_FEW_PCT = 3.0


def findings(
    plan: ExperimentPlan,
    setup: Setup,
    command: str,
    load: Callable[[str], FlightRecord | None],
    notes: Sequence[str],
) -> Result:
    """The result of an experiment from its stored flights; schemes that cannot fly have none.

    Args:
        load: a flight by its key; ``None`` if the scheme could not fly.
        notes: of the run, such as the reason why a scheme could not fly.

    Raises:
        UsageError: no scheme flew at all.
    """
    groups = groups_of(plan, load)
    flying = [group for group in groups if group.scheme.name != BOUND.name]
    if not flying:
        raise UsageError(f"experiment {plan.experiment.name}: no scheme could fly. {' '.join(notes)}")
    experiment, seeds = plan.experiment, max((group.seeds for group in flying), key=len)
    schemes, curves, missing = _scores(experiment, flying)
    compared = comparisons(experiment, flying, groups)
    return Result(
        experiment=experiment.name,
        title=experiment.title,
        command=command,
        version=version("aic-vds"),
        commit=", ".join(sorted({str(flight.commit) for group in groups for flight in group.flights})),
        created_at=max(flight.flown_at for group in groups for flight in group.flights),
        quick=setup.quick,
        scenario=", ".join(dict.fromkeys(group.flights[0].scenario for group in flying)),
        seeds=seeds,
        model=_model(flying),
        schemes=schemes,
        bound=bounds(groups),
        curves=curves,
        paired=compared.pairs,
        sweep=experiment.sweep,
        figures=[_figure(spec, flying, seeds, command) for spec in experiment.figures],
        labels=_labels(flying, experiment.measures, experiment.figures) | compared.labels,
        seeds_of={group.scheme.name: group.seeds for group in flying if group.seeds != seeds},
        notes=[*experiment.notes, *compared.notes, *_notes(plan, setup, groups), *notes, *missing],
    )


def tidy(result: Result) -> str:
    """``results.csv``: one line a scheme and seed, and one a seed for the bound; a column a measure."""
    text = StringIO()
    found = {**result.schemes, BOUND.name: _once(result.bound)}
    measures = list(dict.fromkeys(measure for of_scheme in found.values() for measure in of_scheme))
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["scheme", "seed", *measures])
    for scheme, of_scheme in found.items():
        for number, seed in enumerate(result.seeds_of.get(scheme, result.seeds) if of_scheme else ()):
            values = (f"{of_scheme[m].values[number]:g}" if m in of_scheme else "" for m in measures)
            rows.writerow([scheme, seed, *values])
    return text.getvalue()


def _once(bound: dict[str, Interval]) -> dict[str, Interval]:
    """The bound of a mission's losses; the same number also bounds the last step of a curve."""
    return {name: found for name, found in bound.items() if name.partition("@")[0] in MEASURES}


def _scores(
    experiment: Experiment, flying: Sequence[Group]
) -> tuple[dict[str, dict[str, Interval]], dict[str, dict[str, Curve]], list[str]]:
    """Measures and curves by scheme, and notes on missing ones."""
    schemes: dict[str, dict[str, Interval]] = {}
    curves: dict[str, dict[str, Curve]] = {}
    notes: list[str] = []
    for group in flying:
        found, missing = _measured(group, experiment.measures)
        schemes.setdefault(group.scheme.name, {}).update(found)
        notes += missing
        if drawn := _curves(group, experiment.figures):
            curves.setdefault(group.scheme.name, {}).update(drawn)
    return schemes, curves, notes


def _measured(group: Group, measures: Sequence[str]) -> tuple[dict[str, Interval], list[str]]:
    found, missing = {}, []
    for name in measures:
        values = [MEASURES[name].of(flight) for flight in group.flights]
        present = [value for value in values if value is not None]
        if len(present) == len(values):
            found[name + group.suffix] = interval(present)
        elif present:
            missing.append(
                f"{group.scheme.label}: {MEASURES[name].label} is left out, for it has none on "
                f"{len(values) - len(present)} of {len(values)} seeds."
            )
    return found, missing


def _curves(group: Group, figures: Sequence[FigureSpec]) -> dict[str, Curve]:
    names = [m for spec in figures if spec.kind == "curves" for m in spec.measures]
    found = {}
    for name in names:
        rows = [STEP_MEASURES[name].of(flight) for flight in group.flights]
        present = [row for row in rows if row is not None]
        if len(present) == len(rows):
            found[name + group.suffix] = curve(present)
    return found


def _figure(spec: FigureSpec, flying: Sequence[Group], seeds: Sequence[int], command: str) -> Figure:
    suffixes = list(dict.fromkeys(group.suffix for group in flying))
    flown = {len(group.seeds) for group in flying if group.scheme.asks_llm}
    fewer = f" ({', '.join(str(n) for n in sorted(flown))} for those that ask an LLM)" if flown - {len(seeds)} else ""
    return Figure(
        name=spec.name,
        kind=spec.kind,
        measures=[measure + suffix for measure in spec.measures for suffix in suffixes],
        caption=f"{spec.caption} Mean over {len(seeds)} seeds{fewer}, {flying[0].flights[0].steps} steps, with "
        f"its {METHOD}. Made by `{command}`.",
    )


def _labels(flying: Sequence[Group], measures: Sequence[str], figures: Sequence[FigureSpec]) -> dict[str, str]:
    labels = {group.scheme.name: group.scheme.label for group in flying}
    shown = dict.fromkeys([*measures, *(m for spec in figures for m in spec.measures)])
    for group in flying:
        where = f", {group.site}" if group.suffix else ""
        for name in shown:
            measure = MEASURES.get(name) or STEP_MEASURES[name]
            labels[name + group.suffix] = measure.label + where
    return labels


def _model(flying: Sequence[Group]) -> str | None:
    models = [f.model for group in flying if group.scheme.asks_llm for f in group.flights if f.model]
    return ", ".join(dict.fromkeys(models)) or None


def _notes(plan: ExperimentPlan, setup: Setup, groups: Sequence[Group]) -> list[str]:
    notes = [f"Intervals: {METHOD} over seeds; a curve's likewise, at each step. Comparisons are paired by seed."]
    if setup.quick:
        steps = next((group.flights[0].steps for group in groups), 0)
        notes.append(
            f"Quick run: missions of {steps} steps, few seeds. It shows that the figure can be made, not what it says."
        )
    if plan.left_out:
        labels = ", ".join(scheme.label for scheme in plan.left_out)
        short = "by --quick, whose missions with an LLM would be too short for it"
        backings = [scheme.decides.backing for scheme in plan.left_out if isinstance(scheme.decides, OverEdge)]
        flies = all(map(setup.llm.flies, backings))
        notes.append(f"Left out {short if flies else 'for want of an LLM or its adapter'}: {labels}.")
    for group in groups:
        notes += _doubts(group)
    notes += _below_bound(groups)
    if any(isinstance(group.scheme.decides, OverEdge) for group in groups):
        notes.append("The edge's modules learn beside its decisions: a mission flown anew may differ a little.")
    return notes


def _below_bound(groups: Sequence[Group]) -> list[str]:
    least = {(g.site, f.seed): f.bound.lower_bound for g in groups for f in g.flights if f.bound}
    below = [
        f"{group.scheme.label}{group.suffix}, seed {flight.seed}"
        for group in groups
        for flight in group.flights
        if not flight.bound and sum(flight.lost_packets) < least.get((group.site, flight.seed), 0)
    ]
    return [f"The bound is wrong: less than it was lost by {'; '.join(below)}."] if below else []


def _doubts(group: Group) -> list[str]:
    notes = []
    decisions = sum(len(flight.decisions) for flight in group.flights)
    instead = sum(substituted_decisions(flight) for flight in group.flights)
    if group.scheme.is_answered and 100 * instead > _FEW_PCT * decisions:
        reasons = sorted(
            {d.reason for f in group.flights for d in f.decisions if d.reason and d.reason != "no_candidate"}
        )
        notes.append(
            f"{group.scheme.label}{group.suffix}: {instead} of {decisions} decisions are not the LLM's but were taken "
            f"in its place ({', '.join(reasons)}). Its row does not measure the LLM."
        )
    unproven = [f.bound for f in group.flights if f.bound and not f.bound.optimal]
    if unproven:
        gap = max(b.lost_packets - b.lower_bound for b in unproven)
        notes.append(
            f"{group.scheme.label}{group.suffix}: proven optimal on {len(group.flights) - len(unproven)} of "
            f"{len(group.flights)} seeds; on the others the best plan found loses up to {gap:g} packets more than the "
            "proven bound."
        )
    return notes
