"""Evidence from results: the difference of two schemes, the end of losses, and whether an LLM beats chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lab.experiments import intervals
from lab.experiments.plots import measured
from lab.experiments.result import Interval, Paired, Result
from lab.experiments.stand_ins import NAMES
from shared.world.channel import FloatArray

# The largest mean loss a step that counts as zero; the steps of its moving average, and the fewest at a mission's
# end.
ZERO = 0.05
WINDOW, LEAST_REMAINING = 5, 3
# The paper's method among our schemes, and its references by chance: random draws in place of the LLM or, as a weaker
# test, of the whole scheme.
METHOD, CHANCE = "llm", ("llm_chance", "random")

Runs = Mapping[str, Result]


class Unmeasured(Exception):
    """The results lack a number that a rule needs; the text names it."""


def settled_at(means: Sequence[float] | FloatArray) -> int | None:
    """The step from which on the moving average of a curve stays at ``ZERO`` or less; ``None`` if it does not.

    The average at a step is over it and the four that follow, or those that remain, at least three. One late packet in
    30 worlds is 0.03 in its step and 0.007 in the average, so it does not reset the statistic. This is Welch's
    procedure for the end of a simulation's initial transient: the mean over replications, then a moving average
    (P. D. Welch, "The statistical analysis of simulation results", in Lavenberg (ed.), Computer Performance Modeling
    Handbook, Academic Press, 1983).
    """
    curve = np.asarray(means, dtype=float)
    starts = range(max(0, len(curve) - LEAST_REMAINING + 1))
    late = [start for start in starts if curve[start : start + WINDOW].mean() > ZERO + 1e-12]
    at = late[-1] + 1 if late else 0
    return at if at < len(starts) else None


def seeds_flown(result: Result, *names: str) -> int:
    """The smallest number of seeds that one of the schemes flew."""
    return min(len(result.seeds_of.get(name, result.seeds)) for name in names)


def flew_all(result: Result, name: str) -> bool:
    """Whether a scheme flew every world of the result; means over different worlds cannot be compared."""
    return len(result.seeds_of.get(name, result.seeds)) == len(result.seeds)


def difference(result: Result, scheme: str, reference: str, measure: str) -> Paired:
    """``scheme``'s measure less ``reference``'s, over the worlds that both flew.

    Raises:
        Unmeasured: one of them lacks the measure, or no world is common.
    """
    return _compared(result, scheme, reference, measure)[0]


def ratio(result: Result, scheme: str, reference: str, measure: str) -> Paired:
    """``scheme``'s mean to ``reference``'s, over the worlds that both flew.

    Raises:
        Unmeasured: as :func:`difference`, or the reference's mean is 0 in these worlds or in a resample of them.
    """
    found = _compared(result, scheme, reference, measure)
    if len(found) < 2:
        raise Unmeasured(f"{measure} of {reference} is 0 in too many worlds for a ratio")
    return found[1]


def _compared(result: Result, scheme: str, reference: str, measure: str) -> Sequence[Paired]:
    of_both = (scheme, reference, measure)
    found = {one.kind: one for one in result.paired if (one.scheme, one.reference, one.measure) == of_both}
    if found.keys() >= {"difference", "ratio"}:
        return found["difference"], found["ratio"]
    ours, theirs = _by_seed(result, scheme, measure), _by_seed(result, reference, measure)
    common = sorted(ours.keys() & theirs.keys())
    if not common:
        raise Unmeasured(f"{scheme} and {reference} flew no world in common")
    pairs = [ours[seed] for seed in common], [theirs[seed] for seed in common]
    return intervals.paired(scheme, reference, measure, *pairs)


def _by_seed(result: Result, name: str, measure: str) -> dict[int, float]:
    seeds = result.seeds_of.get(name, result.seeds)
    values = interval_of(result, name, measure).values
    if len(values) != len(seeds):
        raise Unmeasured(f"{measure} of {name} has {len(values)} values for {len(seeds)} seeds")
    return dict(zip(seeds, values, strict=True))


def interval_of(result: Result, name: str, measure: str) -> Interval:
    """The scheme's interval of the measure; raises ``Unmeasured`` without one."""
    found = measured(result, name, measure)
    if found is None:
        raise Unmeasured(f"{measure} of {name}")
    return found


def beats_chance(result: Result, runs: Runs) -> bool | None:
    """Whether the LLM's decisions lose fewer packets than random draws; ``None`` without a scheme by chance.

    The comparison is within ``result``, or else within another run of the same LLM.
    """
    others = [run for run in runs.values() if _same_model(run, result) and (result.quick or not run.quick)]
    for chance in CHANCE:
        for run in (result, *others):
            if measured(run, METHOD, "lost_packets") and measured(run, chance, "lost_packets"):
                return difference(run, METHOD, chance, "lost_packets").high < 0
    return None


def _same_model(a: Result, b: Result) -> bool:
    models = [set((result.model or "").split(", ")) - {"", *NAMES.values()} for result in (a, b)]
    return bool(models[0] & models[1])
