import math

import pytest

from service.learning.trust import Advice, Trust

PRIOR = {"llm": 0.5, "value": 0.25, "policy": 0.25}


def advise(trust: Trust, regret: dict[str, float], *, cost: float = 0.0, expected: float = 0.0, times: int = 1) -> None:
    for _ in range(times):
        trust.open["a" * 32] = Advice(regret, dict.fromkeys(regret, 0.5), expected)
        trust.settle("a" * 32, cost)


def test_the_prior_is_normalised() -> None:
    assert Trust({"llm": 2.0, "value": 1.0, "policy": 1.0}).weights == PRIOR


def test_a_bad_llm_is_given_up_within_five_decisions() -> None:
    trust = Trust(PRIOR)
    advise(trust, {"llm": 8.0, "value": 1.0, "policy": 0.5}, times=5)
    assert trust.weights["llm"] < 0.02
    assert sum(trust.weights.values()) == pytest.approx(1.0)


def test_a_good_llm_is_found_out_and_found_again_after_it_was_bad() -> None:
    trust = Trust(PRIOR)
    advise(trust, {"llm": 8.0, "value": 0.0, "policy": 0.0}, times=50)
    advise(trust, {"llm": 0.0, "value": 4.0, "policy": 4.0}, times=12)
    assert trust.weights["llm"] > 0.9


def test_where_all_do_alike_the_prior_comes_back() -> None:
    trust = Trust(PRIOR)
    advise(trust, {"llm": 8.0, "value": 0.0, "policy": 0.0}, times=5)
    advise(trust, {"llm": 0.0, "value": 0.0, "policy": 0.0}, times=1000)
    assert trust.weights == pytest.approx(PRIOR, abs=0.01)


def test_no_adviser_is_ever_given_up_for_good() -> None:
    trust = Trust(PRIOR)
    advise(trust, {"llm": 8.0, "value": 0.0, "policy": 8.0}, times=500)
    assert min(trust.weights.values()) >= 0.01 * min(PRIOR.values()) - 1e-12


def test_who_is_silent_keeps_its_weight() -> None:
    trust = Trust(PRIOR)
    advise(trust, {"value": 8.0, "policy": 0.0}, times=10)
    assert trust.weights["llm"] == 0.5
    assert trust.weights["policy"] > 0.45
    assert sum(trust.weights.values()) == pytest.approx(1.0)


def test_who_advised_what_failed_unexpectedly_is_trusted_less() -> None:
    trust = Trust(PRIOR)
    trust.open["a" * 32] = Advice(dict.fromkeys(PRIOR, 0.0), {"llm": 1.0, "value": 0.0, "policy": 0.0}, 0.0)
    trust.settle("a" * 32, cost=1.0)
    assert trust.weights["llm"] < 0.3
    # An outcome counts once, and one of a decision that it knows nothing of not at all.
    before = trust.weights
    trust.settle("a" * 32, cost=1.0)
    assert trust.weights == before


@pytest.mark.parametrize(("cost", "most"), [(30.0, 1.0), (-30.0, -1.0)])
def test_no_surprise_counts_more_than_one_failed_transmission(cost: float, most: float) -> None:
    weights = []
    for surprise in (cost, most):
        trust = Trust(PRIOR)
        for _ in range(2):
            advice = Advice(dict.fromkeys(PRIOR, 0.0), {"llm": 0.5, "value": 0.1, "policy": 0.0}, 0.0)
            trust.open["a" * 32] = advice
            trust.settle("a" * 32, surprise)
        weights.append(trust.weights)
    assert weights[0] == weights[1] != PRIOR


def test_a_cost_that_is_always_higher_than_the_critic_thinks_says_nothing_in_the_end() -> None:
    trust = Trust(PRIOR)
    flown = {"llm": 1.0, "value": 0.0, "policy": 0.0}
    weights = []
    for _ in range(200):
        trust.open["a" * 32] = Advice(dict.fromkeys(PRIOR, 0.0), flown, 0.0)
        trust.settle("a" * 32, cost=0.7)
        weights.append(trust.weights["llm"])
    assert weights[-1] > weights[99]


def test_open_advice_is_bounded() -> None:
    trust = Trust(PRIOR, most_open=2)
    for number in range(3):
        trust.open[f"{number:032x}"] = Advice(dict.fromkeys(PRIOR, 0.0), dict.fromkeys(PRIOR, 0.5), 0.0)
    before = trust.weights
    trust.settle(f"{0:032x}", 1.0)
    assert trust.weights is before
    trust.settle(f"{2:032x}", 1.0)
    assert trust.weights is not before


@pytest.mark.parametrize("odd", [1e9, -1e9])
def test_no_loss_however_large_breaks_the_weights(odd: float) -> None:
    trust = Trust(PRIOR)
    advise(trust, {"llm": odd, "value": 0.0, "policy": 0.0}, times=100)
    assert all(math.isfinite(w) and w > 0 for w in trust.weights.values())


def test_a_restored_trust_goes_on_as_it_was() -> None:
    trust, again = Trust(PRIOR), Trust(PRIOR)
    flown = {"llm": 1.0, "value": 0.2, "policy": 0.0}
    for number, cost in enumerate((0.9, 0.4, 0.0)):
        trust.open[f"{number:032x}"] = Advice(dict.fromkeys(PRIOR, 0.5), flown, 0.1)
        if number < 2:
            trust.settle(f"{number:032x}", cost)
    again.load_state_dict(trust.state_dict())
    for one in (trust, again):
        one.settle(f"{2:032x}", 0.0)
    assert again.state_dict() == trust.state_dict()
    assert trust.weights != PRIOR


def test_a_state_of_other_advisers_is_ignored() -> None:
    trust = Trust(PRIOR)
    trust.load_state_dict(Trust({"llm": 0.9, "planner": 0.1}).state_dict())
    assert trust.weights == PRIOR


def odds_after(prior: dict[str, float], flown: float, cost: float) -> float:
    """The odds of the LLM against the policy, in units of those before, after one decision that cost this much."""
    trust = Trust(prior)
    before = trust.weights["llm"] / trust.weights["policy"]
    trust.open["a" * 32] = Advice({"llm": 0.0, "policy": 0.0}, {"llm": flown, "policy": 0.0}, 0.0)
    trust.settle("a" * 32, cost)
    # Without the fixed share of a hundredth.
    own = {name: weight - 0.01 * prior[name] for name, weight in trust.weights.items()}
    return own["llm"] / own["policy"] / before


@pytest.mark.parametrize(
    ("llm", "flown", "factor"),
    [(0.5, 1.0, 2.0), (0.25, 1.0, 4.0), (0.1, 1.0, 4.0), (0.1, 0.5, 2.0), (0.01, 0.25, 1.0)],
)
def test_a_surprise_counts_four_packets_and_its_factor_is_at_most_four(llm: float, flown: float, factor: float) -> None:
    odds = odds_after({"llm": llm, "policy": 1.0 - llm}, flown, cost=0.25)
    assert odds == pytest.approx(math.exp(-0.6 * factor * 4.0 * 0.25))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_loss_beyond_eight_packets_counts_as_eight(sign: float) -> None:
    weights = []
    for regret in (8.0, 80.0):
        trust = Trust(PRIOR)
        trust.update({"llm": sign * regret, "value": 0.0, "policy": 0.0}, dict.fromkeys(PRIOR, 0.0), 0.0)
        weights.append(trust.weights)
    assert weights[0] == weights[1] != PRIOR
