"""The paper's claims at one point of the map: our numbers, and the stand-ins of its method for which each holds.

The paper's own LLM is not available. Three deciders stand in for its method: look-ahead behind attention (k = 5) from a
random and from the shipped start, and mode `value`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lab.claims_map.flights import EVERY_SENSOR, FORMULAS, KEPT, STARTS, Flown, chooser_name
from lab.experiments.claims import HEURISTICS_ZERO_AT, JAIN, MADQN_ZERO_AT, NEAR_JAIN, NEAR_STEPS, OURS_ZERO_AT
from lab.experiments.evidence import ZERO, settled_at
from lab.experiments.intervals import interval, paired
from lab.experiments.result import Paired
from simulator.records.decision import jain_index

# The paper's initial transient, steps 0 to 3.
TRANSIENT_STEPS = 4
BASELINES = ("eof", "wqcs", "madqn_paper", "mappo")
# The stand-ins by their letters in the figure.
STAND_INS = {"r": chooser_name("random", 5), "s": chooser_name("shipped", 5), "v": "value"}
Flights = Mapping[str, Flown]


@dataclass(frozen=True)
class Judgement:
    """The judgement of a claim at one point.

    Attributes:
        of: the stand-ins, starts or schemes for which it was judged, and whether it holds for each.
        ours: our numbers, in words.
        moot: whether the claim is not judged, because hardly a packet is lost.
    """

    of: dict[str, bool]
    ours: str
    moot: bool = False

    @property
    def share(self) -> float:
        """The share of ``of`` for which the claim holds; NaN if it is moot."""
        return float("nan") if self.moot else sum(self.of.values()) / len(self.of)


@dataclass(frozen=True)
class MapClaim:
    """One of the paper's claims, abridged, with the rule that judges it."""

    name: str
    stated: str
    rule: Callable[[Flights], Judgement]


def settled_step(flown: Flown) -> int | None:
    """The step at which a scheme's lost packets, averaged over worlds, settle."""
    return settled_at(flown.lost.mean(axis=0))


def _worlds(flown: Flown) -> list[float]:
    return [float(total) for total in flown.lost.sum(axis=1)]


def _difference(flights: Flights, scheme: str, reference: str, steps: slice = slice(None)) -> Paired:
    ours, theirs = (flights[name].lost[:, steps].sum(axis=1).tolist() for name in (scheme, reference))
    return paired(scheme, reference, "lost_packets", ours, theirs)[0]


def _at(step: int | None) -> str:
    return "never" if step is None else f"step {step}"


def _zero_by_four(flights: Flights) -> Judgement:
    at = {letter: settled_step(flights[name]) for letter, name in STAND_INS.items()}
    held = {letter: step is not None and step <= OURS_ZERO_AT for letter, step in at.items()}
    return Judgement(held, _steps(at))


def _steps(at: Mapping[str, int | None]) -> str:
    return "; ".join(f"{name}: {_at(step)}" for name, step in at.items())


def _zero_near(names: Sequence[str], stated: int, flights: Flights) -> Judgement:
    at = {name: settled_step(flights[name]) for name in names}
    return Judgement({n: s is not None and abs(s - stated) <= NEAR_STEPS for n, s in at.items()}, _steps(at))


def _first(flights: Flights) -> Judgement:
    ours = {letter: settled_step(flights[name]) for letter, name in STAND_INS.items()}
    theirs = [settled_step(flights[name]) for name in BASELINES[:3]]
    soonest = min((step for step in theirs if step is not None), default=None)
    held = {n: s is not None and (soonest is None or s < soonest) for n, s in ours.items()}
    return Judgement(held, f"{_steps(ours)}; EOF, WQCS, MADQN: {', '.join(map(_at, theirs))}")


def _against_baselines(flights: Flights, steps: slice, more: bool) -> Judgement:
    held, texts = dict[str, bool](), list[str]()
    for letter, name in STAND_INS.items():
        differences = [_difference(flights, name, baseline, steps) for baseline in BASELINES]
        held[letter] = all(d.low > 0 if more else d.high < 0 for d in differences)
        texts.append(
            f"{letter}: {', '.join(f'{d.mean:.1f} to {b}' for d, b in zip(differences, BASELINES, strict=True))}"
        )
    return Judgement(held, "; ".join(texts))


def _fewest(flights: Flights) -> Judgement:
    return _against_baselines(flights, slice(None), more=False)


def _larger_transient(flights: Flights) -> Judgement:
    return _against_baselines(flights, slice(0, TRANSIENT_STEPS), more=True)


def _mappo_stable(flights: Flights) -> Judgement:
    """The paired interval of the last third less the first contains 0, and losses go on."""
    lost = flights["mappo"].lost
    third = lost.shape[1] // 3
    early, late = (lost[:, part].mean(axis=1).tolist() for part in (slice(0, third), slice(-third, None)))
    change = paired("late", "early", "lost_packets", late, early)[0]
    goes_on = float(lost.mean()) > ZERO
    text = f"{np.mean(early):.2f} a step in the first third, {np.mean(late):.2f} in the last"
    return Judgement({"mappo": goes_on and change.low <= 0 <= change.high}, text)


def _by_start(
    flights: Flights, others: Callable[[str], Sequence[tuple[str, str]]], agrees: Callable[[Paired], bool]
) -> Judgement:
    """Pairs of choosers by the start; moot if no chooser of any pair loses more than ``ZERO`` a step."""
    held, texts, most = dict[str, bool](), list[str](), 0.0
    for start in STARTS:
        differences = [_difference(flights, scheme, reference) for scheme, reference in others(start)]
        held[start[0]] = all(map(agrees, differences))
        texts += [f"{d.scheme} less {d.reference}: {d.mean:.1f} [{d.low:.1f}, {d.high:.1f}]" for d in differences]
        most = max(most, *(float(flights[name].lost.mean()) for pair in others(start) for name in pair))
    return Judgement(held, "; ".join(texts), moot=most <= ZERO)


def _attention_harmless(flights: Flights) -> Judgement:
    return _by_start(flights, lambda s: [(chooser_name(s, 5), EVERY_SENSOR)], lambda d: d.low <= 0 <= d.high)


def _three_worse(flights: Flights) -> Judgement:
    return _by_start(flights, lambda s: [(chooser_name(s, 3), chooser_name(s, 5))], lambda d: d.low > 0)


def _more_no_better(flights: Flights) -> Judgement:
    def pairs(start: str) -> list[tuple[str, str]]:
        return [(other, chooser_name(start, 5)) for other in (chooser_name(start, KEPT[-1]), EVERY_SENSOR)]

    return _by_start(flights, pairs, lambda d: d.high >= 0)


def _even(flights: Flights) -> Judgement:
    found = {n: interval([jain_index(w) or 0.0 for w in flights[s].visits.tolist()]) for n, s in STAND_INS.items()}
    text = "; ".join(f"{name}: {index.mean:.3f}" for name, index in found.items())
    return Judgement({name: index.high >= JAIN - NEAR_JAIN for name, index in found.items()}, text)


CLAIMS: tuple[MapClaim, ...] = (
    MapClaim("zero_by_4", f"AIC-VDS loses nothing\nfrom step {OURS_ZERO_AT}", _zero_by_four),
    MapClaim(
        "heuristics_at_20",
        f"EOF and WQCS reach zero\nonly by step {HEURISTICS_ZERO_AT} (±{NEAR_STEPS})",
        partial(_zero_near, FORMULAS, HEURISTICS_ZERO_AT),
    ),
    MapClaim(
        "madqn_at_27",
        f"MADQN reaches zero\nonly by step {MADQN_ZERO_AT} (±{NEAR_STEPS})",
        partial(_zero_near, ("madqn_paper",), MADQN_ZERO_AT),
    ),
    MapClaim("first", "AIC-VDS is at zero before\nEOF, WQCS and MADQN", _first),
    MapClaim("fewest", "AIC-VDS loses less than\neach of the four baselines", _fewest),
    MapClaim("transient", "AIC-VDS loses more than each\nbaseline in steps 0 to 3", _larger_transient),
    MapClaim("mappo_stable", "MAPPO's losses go on,\nneither rising nor falling", _mappo_stable),
    MapClaim("attention", "attention (k = 5)\nmakes no difference", _attention_harmless),
    MapClaim("k3", "k = 3 loses more\nthan k = 5", _three_worse),
    MapClaim("more_k", "k above 5 is no better\nthan k = 5", _more_no_better),
    MapClaim("jain", f"Jain's index of visits\nis {JAIN:.3f} (from {JAIN - NEAR_JAIN:.2f})", _even),
)


def judge(flights: Flights) -> dict[str, Judgement]:
    """Every claim at one point, by its name."""
    return {claim.name: claim.rule(flights) for claim in CLAIMS}


def most_held(held: Mapping[str, Judgement]) -> tuple[str, int]:
    """The stand-in for which most of the claims hold, and their number; a moot claim does not count.

    A claim on the baselines alone holds if it holds for all that it names. A claim on attention's k is judged for the
    stand-in's start; mode `value` has the shipped one.
    """

    def holds(claim: Judgement, letter: str) -> bool:
        if claim.moot:
            return False
        if set(claim.of) <= set(BASELINES):
            return all(claim.of.values())
        return claim.of.get(letter, claim.of.get("s", False))

    counts = {letter: sum(holds(claim, letter) for claim in held.values()) for letter in STAND_INS}
    best = max(counts, key=lambda letter: counts[letter])
    return best, counts[best]
