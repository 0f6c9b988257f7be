"""Trust in the advisers: Hedge with a fixed share, on the estimated cost of each one's advice.

Every adviser e gives a distribution over the same candidates at every decision. So each decision gives an estimated
loss for every adviser, not only for the one that was followed: full information. That is Hedge (Freund and Schapire
1997), and EXP4's experts (Auer, Cesa-Bianchi, Freund and Schapire 2002) without its exploration:

    w_e <- (1 - share) w_e exp(-rate l_e) / Z + share prior_e,     l_e = sum_a p_e(a) l(a),     0 <= l <= cap

Hedge's bound (Freund and Schapire 1997, theorem 2) holds for decisions drawn from the weights and for losses in 0..cap.
Over any number of decisions Hedge loses at most ``cap (rate L_e + ln(1 / prior_e)) / (1 - exp(-rate cap))`` for every
adviser e and its loss L_e. With the rate 0.6, the cap 8 and a prior of 0.2 that is 13 packets + 4.8 L_e: the estimated
loss until a faultless adviser is found, however many decisions a mission has. With a prior of 0.8 it is 1.8 packets.

The bound is plain Hedge's, of estimated losses and of draws. Here the best candidate is flown and the weights are
shared, so the bound guides the constants and promises nothing about lost packets. The fixed share (Herbster and Warmuth
1998) goes to the prior (Bousquet and Warmuth 2002: to the start vector). It leaves every adviser some weight: one that
improves is found again, and the prior returns where all advisers do alike. The odds of an adviser without advice do not
change (sleeping experts: Freund, Schapire, Singer and Warmuth 1997).

``l(a)`` is the rollout evaluator's regret of a candidate, corrected by the outcome. After action b was flown, with the
probability q(b) behind it, the surprise ``s = c - E[c | b]`` is added for the advisers that had advised b, as in a
doubly robust estimate (Dudik, Langford and Li 2011):

    l_e = sum_a p_e(a) regret(a) + min(p_e(b) / q(b), 4) scale (s - mean s),   clipped to -cap..cap

The mean surprise is subtracted because a UAV may report another cost than the evaluator predicts (``--cost paper``).
The best candidate is flown, not a draw, so q(b) is no propensity: an error of the evaluator about candidates that are
never flown stays uncorrected. That is the price of not exploring; a draw would pay for it in lost packets.
"""

from collections.abc import Mapping
from math import exp
from typing import Any, NamedTuple

from shared.kit.bounded import BoundedDict

# The fixed share at each decision: an adviser that improves recovers within some ten decisions.
_SHARE = 0.01
# Log-odds for a packet of regret.
RATE = 0.6
# The largest loss of one decision, packets.
CAP = 8.0
# Packets that one failed transmission more than predicted counts as.
_SCALE = 4.0
# The least q(b), which limits the factor of a surprise to four.
_LEAST_PROBABILITY = 0.25
# Decisions that the mean surprise is averaged over.
_MEMORY = 20

LLM, PLANNER = "llm", "planner"
# The initial weights. The planner looks further ahead than the other advisers, and its quality is known.
PRIOR = {LLM: 0.2, PLANNER: 0.6, "value": 0.1, "policy": 0.1}
# The initial weights without a planner. A bad LLM loses its weight within a few decisions, in which the evaluator
# prevents its worst advice.
PRIOR_UNPLANNED = {LLM: 0.8, "value": 0.1, "policy": 0.1}


class Advice(NamedTuple):
    """The advice for one decision, by name of the adviser; advisers without advice are left out.

    Attributes:
        regret: packets that the advice loses above the best candidate, by the rollout evaluator.
        flown: the advice's probability of the action that was flown.
        expected_cost: of the action that was flown, by the rollout evaluator.
    """

    regret: dict[str, float]
    flown: dict[str, float]
    expected_cost: float


class Trust:
    """The weights of named advisers, which sum to 1, and the advice whose outcome is pending.

    Args:
        prior: initial weight of each adviser; normalised.
        most_open: most decisions with a pending outcome; older ones are dropped.

    Attributes:
        weights: each adviser's weight, 0..1.
        open: by decision, the advice whose outcome is pending.
        updates: number of outcomes that changed the weights.
    """

    def __init__(self, prior: Mapping[str, float], most_open: int = 64) -> None:
        self.open = BoundedDict[str, Advice](most_open)
        total = sum(prior.values())
        self._prior = {name: weight / total for name, weight in prior.items()}
        self.weights = dict(self._prior)
        self._surprise = 0.0

    def among(self, names: Mapping[str, object]) -> dict[str, float]:
        """The weights of these advisers, scaled to sum to 1."""
        total = sum(self.weights[name] for name in names)
        return {name: self.weights[name] / total for name in names}

    def settle(self, decision_id: str, cost: float) -> None:
        """Update the weights by a decision's realised cost, if its advice is stored."""
        advice = self.open.take(decision_id)
        if advice is not None:
            self.update(advice.regret, advice.flown, self._surprise_of(cost, advice.expected_cost))

    def _surprise_of(self, cost: float, expected: float) -> float:
        """The surprise: a realised cost less the expected cost, and less the mean surprise, in packets."""
        raw = max(-1.0, min(1.0, cost - expected))
        surprise = raw - self._surprise
        self._surprise += (raw - self._surprise) / _MEMORY
        return _SCALE * surprise

    def update(self, regret: Mapping[str, float], flown: Mapping[str, float], surprise: float) -> None:
        """Update the weights by one decision.

        Args:
            regret: by adviser with advice, packets that the advice loses above the best candidate.
            flown: by adviser with advice, its probability of the action that was flown.
            surprise: realised cost less the expected cost and less the mean surprise, packets.
        """
        weights = self.among(regret)
        probability = max(_LEAST_PROBABILITY, sum(weights[name] * flown[name] for name in weights))
        advising = sum(self.weights[name] for name in regret)
        updated = {}
        for name, weight in weights.items():
            loss = regret[name] + min(flown[name] / probability, 1.0 / _LEAST_PROBABILITY) * surprise
            updated[name] = weight * exp(-RATE * max(-CAP, min(CAP, loss)))
        total = sum(updated.values())
        prior = sum(self._prior[name] for name in updated)
        own = {name: (1.0 - _SHARE) * weight / total for name, weight in updated.items()}
        shifted = {name: advising * (own[name] + _SHARE * self._prior[name] / prior) for name in own}
        self.weights = {**self.weights, **shifted}

    def state_dict(self) -> dict[str, Any]:
        """The weights, the mean surprise and the pending advice, as copies."""
        return {
            "weights": dict(self.weights),
            "surprise": self._surprise,
            "open": [(name, advice._asdict()) for name, advice in self.open.items()],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state; one of other advisers is ignored."""
        if state["weights"].keys() != self._prior.keys():
            return
        self.weights, self._surprise = state["weights"], state["surprise"]
        self.open.clear()
        for name, advice in state["open"]:
            self.open[name] = Advice(**advice)
