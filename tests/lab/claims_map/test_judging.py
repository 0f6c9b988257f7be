"""The rules of the claims map, on made-up losses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from lab.claims_map.flights import SCHEMES, Flown
from lab.claims_map.judging import CLAIMS, judge, most_held

STEPS, WORLDS = 30, 6


def flown(losses: Sequence[int], visits: Sequence[int] = (9, 9)) -> Flown:
    """A scheme that loses these packets in its first steps, in every world."""
    lost = np.zeros((WORLDS, STEPS), dtype=np.int64)
    lost[:, : len(losses)] = losses
    none = np.zeros_like(lost)
    return Flown(lost, none, none, np.tile(np.asarray(visits), (WORLDS, 1)), 0.0, "abc")


def flights(**losses: Sequence[int]) -> dict[str, Flown]:
    return {scheme: flown(losses.get(scheme, [3])) for scheme in SCHEMES}


OURS = ("look_ahead_random_k5", "look_ahead_shipped_k5", "value")
AS_THE_PAPER_SAYS = flights(
    **{key: [9, 9, 9, 9] for key in (*OURS, "look_ahead_random_k7", "look_ahead_shipped_k7", "look_ahead_all")},
    eof=[1] * 20,
    wqcs=[1] * 18,
    madqn_paper=[2] * 25,
    mappo=[2] * 30,
    look_ahead_random_k3=[9] * 8,
    look_ahead_shipped_k3=[9] * 8,
)


def test_every_claim_but_those_on_totals_and_visits_holds_where_losses_are_as_the_paper_says() -> None:
    held = judge(AS_THE_PAPER_SAYS)
    assert [name for name, found in held.items() if not all(found.of.values())] == ["fewest"]
    assert not any(found.moot for found in held.values())
    assert most_held(held) == ("r", len(CLAIMS) - 1)


def test_the_fewest_packets_are_judged_against_each_baseline() -> None:
    held = judge({**AS_THE_PAPER_SAYS, **dict.fromkeys(OURS, flown([9]))})["fewest"]
    assert held.of == {"r": True, "s": True, "v": True}


def test_a_claim_fails_for_the_stand_in_that_contradicts_it() -> None:
    held = judge({**AS_THE_PAPER_SAYS, "value": flown([9] * 9, visits=[1, 9])})
    assert held["zero_by_4"].of == {"r": True, "s": True, "v": False}
    assert held["jain"].of == {"r": True, "s": True, "v": False}
    assert held["zero_by_4"].share == pytest.approx(2 / 3)
    assert most_held(held)[0] == "r"


def test_claims_on_attention_are_moot_where_nothing_is_lost() -> None:
    held = judge(flights(**{scheme: [] for scheme in SCHEMES}))
    assert {name for name, found in held.items() if found.moot} == {"attention", "k3", "more_k"}
    assert np.isnan(held["k3"].share)


def test_mappo_that_settles_or_gets_worse_is_not_stable() -> None:
    for losses in ([9, 9, 9], [0] * 20 + [4] * 10, []):
        assert judge({**AS_THE_PAPER_SAYS, "mappo": flown(losses)})["mappo_stable"].of == {"mappo": False}
