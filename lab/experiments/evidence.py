"""Evidence from results: the difference of two schemes, the end of losses, and whether an LLM beats chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lab.experiments import intervals
from lab.experiments.plots import measured
from lab.experiments.result import Interval, Paired, Result
from lab.experiments.stand_ins import NAMES

# The largest mean loss a step over missions that counts as zero.
ZERO = 0.05
# The paper's method among our schemes, and its references by chance: random draws in place of the LLM or, as a weaker
# test, of the whole scheme.
METHOD, CHANCE = "llm", ("llm_chance", "random")

Runs = Mapping[str, Result]


class Unmeasured(Exception):
    """The results lack a number that a rule needs; the text names it."""


def settled_at(means: Sequence[float]) -> int | None:
    """The step from which on a curve stays at ``ZERO`` or less; ``None`` if it does not by its end."""
    late = [step for step, mean in enumerate(means) if mean > ZERO]
    settled = late[-1] + 1 if late else 0
    return settled if settled < len(means) else None


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
    for found in result.paired:
        if (found.scheme, found.reference, found.measure, found.kind) == (scheme, reference, measure, "difference"):
            return found
    ours, theirs = _by_seed(result, scheme, measure), _by_seed(result, reference, measure)
    common = sorted(ours.keys() & theirs.keys())
    if not common:
        raise Unmeasured(f"{scheme} and {reference} flew no world in common")
    pairs = [ours[seed] for seed in common], [theirs[seed] for seed in common]
    return intervals.paired(scheme, reference, measure, *pairs)[0]


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
    beside = [run for run in runs.values() if _same_model(run, result) and (result.quick or not run.quick)]
    for chance in CHANCE:
        for run in (result, *beside):
            if measured(run, METHOD, "lost_packets") and measured(run, chance, "lost_packets"):
                return difference(run, METHOD, chance, "lost_packets").high < 0
    return None


def _same_model(a: Result, b: Result) -> bool:
    models = [set((result.model or "").split(", ")) - {"", *NAMES.values()} for result in (a, b)]
    return bool(models[0] & models[1])
