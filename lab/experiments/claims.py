"""The paper's claims, and rules that judge them by our results.

A result of a quick run gets no verdict. "Zero" is as in ``evidence.settled_at``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from lab.experiments import adapter_claims
from lab.experiments.evidence import (
    METHOD,
    ZERO,
    Runs,
    Unmeasured,
    beats_chance,
    difference,
    interval_of,
    ratio,
    seeds_flown,
    settled_at,
)
from lab.experiments.plots import label_of, measured
from lab.experiments.result import Interval, Paired, Result
from shared.world.scenario import Scenario

CLAIM_SEEDS = 30
# The experiment whose schemes have the paper's names, and the LLM with the adapter.
WITH_ADAPTER = adapter_claims.EXPERIMENT.name
# The tolerance of "zero at step 20" in steps.
NEAR_STEPS = 4
# The paper's numbers.
OURS_ZERO_AT, HEURISTICS_ZERO_AT, MADQN_ZERO_AT = 4, 20, 27
TOKENS_WITHOUT, TOKENS_WITH = 213.7, 106.8
JAIN = 0.980
NEAR_JAIN, NEAR_SAVED_POINTS = 0.01, 5.0
# The paper's baselines; the paper's MAPPO on the plain state is not trained here, and ours has more features.
RIVALS = ("eof", "wqcs", "madqn_paper", "mappo")
# The method without attention.
UNATTENDED = "llm_all"
LOSSES = {"lost_packets_per_step": "lost packets", "events_per_step": "loss events"}


class Verdict(StrEnum):
    """The verdict on a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    NOT_COMPARABLE = "not comparable"


@dataclass(frozen=True)
class Judged:
    """A rule's outcome: our numbers in words, the verdict, its reason, and the smallest number of seeds behind it."""

    ours: str
    verdict: Verdict
    why: str
    seeds: int


@dataclass(frozen=True)
class Claim:
    """One of the paper's statements in our words, the experiment that tests it, and the rule that judges it."""

    stated: str
    experiment: str
    rule: Callable[[Result, Runs], Judged]


@dataclass(frozen=True)
class ClaimFinding:
    """A line of the verdict table; without a ``verdict`` the claim is not judged, for the reason ``why``."""

    stated: str
    experiment: str
    ours: str
    verdict: Verdict | None
    why: str
    seeds: int | None = None
    model: str | None = None

    @property
    def few_seeds(self) -> bool:
        """Whether it has fewer seeds than a claim needs."""
        return self.seeds is not None and self.seeds < CLAIM_SEEDS


def judge(runs: Runs) -> list[ClaimFinding]:
    """A finding for each of the paper's claims, including those of experiments not run."""
    return [_finding(claim, runs) for claim in CLAIMS]


def judge_with_adapter(runs: Runs) -> list[ClaimFinding]:
    """The findings of experiment ``adapter-claims``, whose flights test every claim; none where it was not run."""
    result = runs.get(WITH_ADAPTER)
    if result is None:
        return []
    found = judge({claim.experiment: result for claim in CLAIMS})
    return [replace(finding, experiment=WITH_ADAPTER) for finding in found]


def _finding(claim: Claim, runs: Runs) -> ClaimFinding:
    result = runs.get(claim.experiment)
    if result is None:
        return ClaimFinding(claim.stated, claim.experiment, "", None, "not run")
    try:
        judged = claim.rule(result, runs)
    except Unmeasured as error:
        return ClaimFinding(claim.stated, claim.experiment, "", None, f"not measured: {error}", model=result.model)
    if result.quick:
        why = "quick run: no verdict"
        return ClaimFinding(claim.stated, claim.experiment, judged.ours, None, why, judged.seeds, result.model)
    other_setting = setting_difference(result)
    verdict = Verdict.NOT_COMPARABLE if other_setting else judged.verdict
    why = other_setting or judged.why
    return ClaimFinding(claim.stated, claim.experiment, judged.ours, verdict, why, judged.seeds, result.model)


def setting_difference(result: Result) -> str | None:
    """The difference from the paper's worlds and missions; ``None`` if there is none."""
    paper = Scenario()
    if result.scenario != paper.name:
        return f"flown in scenario {result.scenario}"
    steps = {len(curve.mean) for curves in result.curves.values() for curve in curves.values()}
    if steps - {paper.steps}:
        return f"missions of {min(steps)} steps"
    return None


def _text(found: Interval | Paired, digits: int = 1) -> str:
    return f"{found.mean:,.{digits}f} [{found.low:,.{digits}f}, {found.high:,.{digits}f}]"


_NO_BETTER = "the LLM decides no better than chance"
_RANKING_ALONE = f"{_NO_BETTER}: this measures attention's ranking, not what an LLM makes of it"


# --- when losses reach zero


def _zero_by(name: str, step: int, near: int | None) -> Callable[[Result, Runs], Judged]:
    """The rule of a claim of zero by ``step``; with a tolerance ``near`` on either side, or before it if ``None``."""

    def rule(result: Result, runs: Runs) -> Judged:
        means = {label: _curve(result, name, measure) for measure, label in LOSSES.items()}
        ours = "; ".join(f"{label}: {_settling(mean)}" for label, mean in means.items())
        settled = [settled_at(mean) for mean in means.values()]
        seeds = seeds_flown(result, name)
        if all(len(mean) <= step for mean in means.values()):
            return Judged(ours, Verdict.NOT_COMPARABLE, f"the missions end before step {step}", seeds)
        if near is None:
            reached = all(at is not None and at <= step for at in settled)
        else:
            reached = all(at is not None and abs(at - step) <= near for at in settled)
        if reached:
            return Judged(ours, Verdict.REPRODUCED, "both losses are zero by then and stay so", seeds)
        return Judged(ours, Verdict.NOT_REPRODUCED, _why_not_zero(result, runs, name, step, settled), seeds)

    return rule


def _why_not_zero(result: Result, runs: Runs, name: str, step: int, settled: Sequence[int | None]) -> str:
    if all(at is not None and at < step for at in settled):
        return "it is at zero sooner"
    why = ["losses go on" if None in settled else "it is at zero at another step"]
    if name == METHOD and beats_chance(result, runs) is False:
        why.append(_NO_BETTER)
    others = {n: settled_at(c["lost_packets_per_step"].mean) for n, c in result.curves.items() if _has_losses(c)}
    soonest = min(((at, n) for n, at in others.items() if at is not None), default=None)
    if soonest is None:
        why.append("no scheme here stays at zero lost packets")
    else:
        why.append(f"the first at zero lost packets is {label_of(result, soonest[1])}, from step {soonest[0]}")
    return "; ".join(why)


def _has_losses(curves: Mapping[str, object]) -> bool:
    return "lost_packets_per_step" in curves


def _curve(result: Result, name: str, measure: str) -> list[float]:
    found = result.curves.get(name, {}).get(measure)
    if found is None:
        raise Unmeasured(f"{measure} of {name}")
    return found.mean


def _settling(means: Sequence[float]) -> str:
    at = settled_at(means)
    if at is not None:
        return f"zero from step {at}"
    first = next((f"zero first at step {step}, but " for step, mean in enumerate(means) if mean <= ZERO), "")
    last = means[-5:]
    return f"{first}{sum(last) / len(last):.1f} a step at the end"


def _loses_least(result: Result, runs: Runs) -> Judged:
    rivals = {name: measured(result, name, "lost_packets") for name in RIVALS}
    differences = {name: difference(result, METHOD, name, "lost_packets") for name, found in rivals.items() if found}
    missing = [name for name, found in rivals.items() if not found]
    loses_least = all(d.high < 0 for d in differences.values())
    if missing and loses_least:
        raise Unmeasured(f"lost_packets of {', '.join(missing)}")
    ours = "; ".join(f"to {label_of(result, name)} {_text(d)} packets" for name, d in differences.items())
    seeds = seeds_flown(result, METHOD, *differences)
    if loses_least:
        return Judged(ours, Verdict.REPRODUCED, "fewer than each, by paired intervals", seeds)
    better = [label_of(result, name) for name, d in differences.items() if d.low > 0]
    why = f"fewer are lost by {', '.join(better)}" if better else "an interval holds 0"
    if beats_chance(result, runs) is False:
        why += f"; {_NO_BETTER}"
    return Judged(ours, Verdict.NOT_REPRODUCED, why, seeds)


# --- tokens


def _halved(text: str, block: str, why_not: str) -> Callable[[Result, Runs], Judged]:
    def rule(result: Result, runs: Runs) -> Judged:
        saved, seeds = _saved(result, block)
        ours = f"{text} {_text(saved)} % shorter"
        stated = 100 * (1 - TOKENS_WITH / TOKENS_WITHOUT)
        if abs(saved.mean - stated) <= NEAR_SAVED_POINTS:
            why = f"within {NEAR_SAVED_POINTS:g} points of {stated:.0f} %"
            return Judged(ours, Verdict.REPRODUCED, why, seeds)
        return Judged(ours, Verdict.NOT_REPRODUCED, why_not if saved.mean < stated else "it saves more", seeds)

    return rule


def _saved(result: Result, block: str) -> tuple[Interval | Paired, int]:
    """Percent of a block's tokens that attention saves, and the seeds behind it.

    Where the same prompt without attention has flown, it is the reference. Else it is the edge's own account, whose
    uncompressed rows are the paper's: a prompt with shorter rows saves by its row format too.
    """
    name, sent = _method_in(result), f"{block}_tokens"
    if measured(result, UNATTENDED, sent) is None:
        return interval_of(result, name, f"{block}_saved_pct"), seeds_flown(result, name)
    kept = ratio(result, name, UNATTENDED, sent)
    percent = {end: 100 * (1 - value) for end, value in (("mean", kept.mean), ("low", kept.high), ("high", kept.low))}
    return kept.model_copy(update=percent), seeds_flown(result, name, UNATTENDED)


def _token_counts(result: Result, runs: Runs) -> Judged:
    name = _method_in(result)
    unattended = measured(result, UNATTENDED, "prompt_tokens") is not None
    whole, counted = (UNATTENDED, "tokens") if unattended else (name, "uncompressed")
    ours = "; ".join(
        f"{label} {interval_of(result, whole, f'{block}_{counted}').mean:.1f}"
        f" to {interval_of(result, name, f'{block}_tokens').mean:.1f}"
        for label, block in (("prompt", "prompt"), ("state block", "state"))
    )
    why = "another wording and row format; only the ratio can be compared"
    return Judged(ours, Verdict.NOT_COMPARABLE, why, seeds_flown(result, name))


def _method_in(result: Result) -> str:
    return METHOD if METHOD in result.schemes else next(iter(result.schemes))


# --- fairness


def _fair(result: Result, runs: Runs) -> Judged:
    kinds = {"jain": "served", "jain_scheduled": "scheduled"}
    found = {kind: i for measure, kind in kinds.items() if (i := measured(result, METHOD, measure))}
    if not found:
        raise Unmeasured(f"jain of {METHOD}")
    ours = "; ".join(f"visits {kind} {_text(index, 3)}" for kind, index in found.items())
    seeds = seeds_flown(result, METHOD)
    even = [kind for kind, index in found.items() if index.high >= JAIN - NEAR_JAIN]
    if len(even) == len(found):
        return Judged(ours, Verdict.REPRODUCED, f"reaches {JAIN:.3f} to within {NEAR_JAIN:g}", seeds)
    if even:
        why = f"it holds for visits {even[0]} only, and the paper's statement does not say which it counts"
        return Judged(ours, Verdict.NOT_COMPARABLE, why, seeds)
    served = [(index.mean, name) for name in result.schemes if (index := measured(result, name, "jain"))]
    most = ""
    if served:
        most = f"; the most even served here are {label_of(result, max(served)[1])}'s ({max(served)[0]:.3f})"
    return Judged(ours, Verdict.NOT_REPRODUCED, f"visits are less even{most}", seeds)


# --- attention


def _attention_harmless(result: Result, runs: Runs) -> Judged:
    paired = difference(result, METHOD, UNATTENDED, "lost_packets")
    ours = f"with less without attention: {_text(paired)} packets"
    seeds = seeds_flown(result, METHOD, UNATTENDED)
    if beats_chance(result, runs) is False:
        return Judged(ours, Verdict.NOT_COMPARABLE, _RANKING_ALONE, seeds)
    if paired.low <= 0 <= paired.high:
        return Judged(
            ours, Verdict.REPRODUCED, "the paired interval holds 0; its width says how much could hide", seeds
        )
    return Judged(ours, Verdict.NOT_REPRODUCED, "the paired interval leaves out 0", seeds)


def _by_k(result: Result) -> dict[int, str]:
    if result.sweep is None:
        raise Unmeasured("a sweep over k")
    return {int(at): name for name, at in result.sweep.at.items() if name in result.schemes}


def _fewer_is_worse(result: Result, runs: Runs) -> Judged:
    return _against_five(result, runs, lambda k: k == 3, lambda d: d.low > 0, "k=3 loses more", "no clear loss at k=3")


def _more_is_no_better(result: Result, runs: Runs) -> Judged:
    return _against_five(
        result, runs, lambda k: k > 5, lambda d: d.high >= 0, "no larger k is clearly better", "a larger k is better"
    )


def _against_five(
    result: Result,
    runs: Runs,
    which: Callable[[int], bool],
    agrees: Callable[[Paired], bool],
    confirmed: str,
    refuted: str,
) -> Judged:
    names = _by_k(result)
    others = {k: name for k, name in sorted(names.items()) if which(k)}
    if 5 not in names or not others:
        raise Unmeasured("lost packets at k=5 and at the k to compare")
    differences = {k: difference(result, name, names[5], "lost_packets") for k, name in others.items()}
    ours = "; ".join(f"k={k} less k=5: {_text(d)} packets" for k, d in differences.items())
    seeds = seeds_flown(result, names[5], *others.values())
    if beats_chance(result, runs) is False:
        return Judged(ours, Verdict.NOT_COMPARABLE, _RANKING_ALONE, seeds)
    reproduced = all(map(agrees, differences.values()))
    return Judged(
        ours, Verdict.REPRODUCED if reproduced else Verdict.NOT_REPRODUCED, confirmed if reproduced else refuted, seeds
    )


CLAIMS: tuple[Claim, ...] = (
    Claim(f"AIC-VDS loses nothing from step {OURS_ZERO_AT}", "scheduler", _zero_by(METHOD, OURS_ZERO_AT, None)),
    Claim(
        f"EOF reaches zero only by step {HEURISTICS_ZERO_AT}",
        "scheduler",
        _zero_by("eof", HEURISTICS_ZERO_AT, NEAR_STEPS),
    ),
    Claim(
        f"WQCS reaches zero only by step {HEURISTICS_ZERO_AT}",
        "scheduler",
        _zero_by("wqcs", HEURISTICS_ZERO_AT, NEAR_STEPS),
    ),
    Claim(
        f"MADQN reaches zero only by step {MADQN_ZERO_AT}",
        "scheduler",
        _zero_by("madqn_paper", MADQN_ZERO_AT, NEAR_STEPS),
    ),
    Claim("AIC-VDS loses less than EOF, WQCS, MADQN and MAPPO", "scheduler", _loses_least),
    Claim(
        "attention halves the prompt",
        "tokens",
        _halved("prompt", "prompt", "the task's text and experiences are sent whatever attention keeps"),
    ),
    Claim(
        "the same, if only the state block is meant",
        "tokens",
        _halved("state block", "state", "more than half of its tokens remain"),
    ),
    Claim(f"{TOKENS_WITHOUT} tokens become {TOKENS_WITH}", "tokens", _token_counts),
    Claim(f"Jain's index of visits is {JAIN:.3f}", "fairness", _fair),
    Claim("no significant difference with and without attention", "attention", _attention_harmless),
    Claim("k=3 is worse than k=5", "top-k", _fewer_is_worse),
    Claim("k above 5 is no better than k=5", "top-k", _more_is_no_better),
)
