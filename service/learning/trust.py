"""Whom to trust: Hedge with a fixed share over advisers, from what each one's advice would have cost.

Every adviser e gives a distribution over the same candidates at every decision, so a loss can be estimated for each of
them at each decision, not only for the one that was followed: full information. That is Hedge (Freund and Schapire
1997), and EXP4's experts (Auer, Cesa-Bianchi, Freund and Schapire 2002) without its exploration:

    w_e <- (1 - share) w_e exp(-rate l_e) / Z + share prior_e,     l_e = sum_a p_e(a) l(a),     0 <= l <= cap

Hedge's bound (Freund and Schapire 1997, theorem 2), for decisions drawn from the weights and losses of 0..cap: over any
number of decisions it loses at most ``cap (rate L_e + ln(1 / prior_e)) / (1 - exp(-rate cap))`` for every adviser e and
its loss L_e. With the rate 0.6, the cap 8 and a prior of 0.2 that is 13 packets + 4.8 L_e: so much estimated loss it
costs to find out a faultless adviser, however many decisions a mission has; with a prior of 0.8, 1.8 packets.
That bound is plain Hedge's, of estimated losses and of draws. What is flown is the best candidate and the weights are
shared, so it is a guide to the constants and no promise of lost packets. The fixed share (Herbster and Warmuth 1998),
to the prior (Bousquet and Warmuth 2002, to the start vector), keeps every adviser alive, so that one that turns good is
found again, and where all do alike the prior comes back. An adviser that is silent keeps its odds against the others
(sleeping experts: Freund, Schapire, Singer and Warmuth 1997).

``l(a)`` is the critic's regret of a candidate, corrected by what really happened. After action b was flown, with the
probability q(b) behind it, the surprise ``s = c - E[c | b]`` is added where an adviser had advised b, as a doubly
robust estimate would (Dudik, Langford and Li 2011):

    l_e = sum_a p_e(a) regret(a) + min(p_e(b) / q(b), 4) scale (s - mean s),   clipped to -cap..cap

The mean surprise is taken off because a UAV may report another cost than the critic predicts (``--cost paper``).
Decisions are the best candidate, not a draw, so q(b) is no propensity: where the critic is wrong about candidates that
are never flown, nothing corrects it. That is the price of not exploring; a draw would pay for it in lost packets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp
from typing import Any

from shared.bounded import BoundedDict

# Of the weight, a decision: an adviser that turns good after it was given up is back in some ten decisions.
_SHARE = 0.01
# A packet of regret is worth this much in log-odds.
RATE = 0.6
# Packets: one decision, however bad, costs an adviser no more.
CAP = 8.0
# A failed transmission more than predicted counts as this many packets.
_SCALE = 4.0
_LEAST_BEHIND = 0.25
# Decisions that the mean surprise is learned over.
_MEMORY = 20

LLM, PLANNER = "llm", "planner"
# Whom to trust to begin with. The planner sees further than the others and needs no finding out.
PRIOR = {LLM: 0.2, PLANNER: 0.6, "value": 0.1, "policy": 0.1}
# Where there is none, the LLM is believed until it is found out, within a few decisions in which the critic keeps it
# from the worst. An LLM that answers as the planner would lost 17.4 packets with a prior of 0.8, 19.1 with 0.5, the
# planner itself 16.1; one that names the worst 24.2 and 24.1 (20 worlds of scenario `paper`, seeds from 1000 on).
PRIOR_UNPLANNED = {LLM: 0.8, "value": 0.1, "policy": 0.1}


@dataclass(frozen=True, slots=True)
class Advice:
    """What the advisers who spoke said to one decision, by their names.

    ``regret``: packets that the advice loses above the best candidate, by the critic. ``flown``: the probability that
    it gave to what was flown. ``expected_cost`` of what was flown, by the critic.
    """

    regret: Mapping[str, float]
    flown: Mapping[str, float]
    expected_cost: float

    def state_dict(self) -> dict[str, Any]:
        """Its fields."""
        return {"regret": dict(self.regret), "flown": dict(self.flown), "expected_cost": self.expected_cost}


class Trust:
    """The weights of named advisers, which sum to 1, and the advice whose outcome is still to come.

    Args:
        prior: each one's weight before anything is known; normalised.
        most_open: decisions whose outcome may still come; older ones are forgotten.
    """

    def __init__(self, prior: Mapping[str, float], most_open: int = 64) -> None:
        self._open = BoundedDict[str, Advice](most_open)
        total = sum(prior.values())
        self._prior = {name: weight / total for name, weight in prior.items()}
        self._weights = dict(self._prior)
        self._surprise = 0.0
        self.updates = 0

    @property
    def weights(self) -> dict[str, float]:
        """Each adviser's weight, 0..1."""
        return dict(self._weights)

    def among(self, speaking: Mapping[str, object]) -> dict[str, float]:
        """The weights of those that speak, which sum to 1."""
        total = sum(self._weights[name] for name in speaking)
        return {name: self._weights[name] / total for name in speaking}

    def note(self, decision_id: str, advice: Advice) -> None:
        """Remember the advice until the decision's outcome is known."""
        self._open[decision_id] = advice

    def settle(self, decision_id: str, cost: float) -> None:
        """Learn from a decision's realised cost, if its advice is remembered."""
        advice = self._open.take(decision_id)
        if advice is not None:
            self.update(advice.regret, advice.flown, self._excess(cost, advice.expected_cost))

    def _excess(self, cost: float, expected: float) -> float:
        """What a realised cost was above the expected and above what it usually is, packets."""
        raw = max(-1.0, min(1.0, cost - expected))
        excess = raw - self._surprise
        self._surprise += (raw - self._surprise) / _MEMORY
        return _SCALE * excess

    def update(self, regret: Mapping[str, float], flown: Mapping[str, float], surprise: float) -> None:
        """Learn from one decision.

        Args:
            regret: by adviser that spoke, the packets that its advice loses above the best candidate.
            flown: by adviser that spoke, the probability that it gave to what was flown.
            surprise: what the realised cost was above the expected and above what that usually is, packets.
        """
        speaking = self.among(regret)
        behind = max(_LEAST_BEHIND, sum(speaking[name] * flown[name] for name in speaking))
        held = sum(self._weights[name] for name in regret)
        weighed = {}
        for name, weight in speaking.items():
            loss = regret[name] + min(flown[name] / behind, 1.0 / _LEAST_BEHIND) * surprise
            weighed[name] = weight * exp(-RATE * max(-CAP, min(CAP, loss)))
        total = sum(weighed.values())
        prior = sum(self._prior[name] for name in weighed)
        for name in weighed:
            kept = (1.0 - _SHARE) * weighed[name] / total
            self._weights[name] = held * (kept + _SHARE * self._prior[name] / prior)
        self.updates += 1

    def state_dict(self) -> dict[str, Any]:
        """All that it learned, as copies."""
        return {
            "weights": dict(self._weights),
            "surprise": self._surprise,
            "updates": self.updates,
            "open": [(name, advice.state_dict()) for name, advice in self._open.items()],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As it was when the state was taken; where the advisers are others now, it begins anew."""
        if state["weights"].keys() != self._prior.keys():
            return
        self._weights, self._surprise, self.updates = state["weights"], state["surprise"], state["updates"]
        self._open.clear()
        for name, advice in state["open"]:
            self._open[name] = Advice(**advice)
