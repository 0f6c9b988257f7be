"""Each of the paper's claims, confirmed by one synthetic result and not by another."""

from __future__ import annotations

from typing import Any

import pytest

from lab.experiments.claims import WITH_ADAPTER, ClaimFinding, Verdict, judge, judge_with_adapter
from lab.experiments.evidence import Unmeasured, beats_chance, difference, ratio, settled_at
from lab.experiments.result import Result, Sweep
from tests.support.made_results import interval, result, zero_from

REPRODUCED, NOT, APART = Verdict.REPRODUCED, Verdict.NOT_REPRODUCED, Verdict.NOT_COMPARABLE


def finding(stated: str, *results: Result) -> ClaimFinding:
    [found] = [f for f in judge({r.experiment: r for r in results}) if stated in f.stated]
    return found


def losing(llm: float = 10.0, chance: float = 600.0, **others: float) -> Result:
    return result(
        "llm-models", {n: {"lost_packets": v} for n, v in {"llm": llm, "llm_chance": chance, **others}.items()}
    )


def flown(**zeros: int) -> Result:
    schemes = {name: {"lost_packets": float(at)} for name, at in zeros.items()}
    return result("scheduler", schemes, curves={name: zero_from(at) for name, at in zeros.items()})


def by_k(**lost: float) -> Result:
    at = {name: float(name[1:]) for name in lost}
    return result("top-k", {n: {"lost_packets": v} for n, v in lost.items()}, sweep=Sweep(label="k", at=at))


def attended(llm: float, llm_all: float) -> Result:
    """Two schemes whose means differ by ``llm_all - llm``, with noise on each seed."""
    noisy = interval(llm, spread=5.0)
    without = interval(llm_all, spread=5.0).model_copy(update={"values": [llm_all + (-1) ** n for n in range(30)]})
    return result("attention", {"llm": {"lost_packets": noisy}, "llm_all": {"lost_packets": without}})


def beside_unattended(kept: float) -> Result:
    """A compact prompt that keeps so many of 100 tokens, and by the edge's account saves half of the paper's rows."""
    saved = {"prompt_saved_pct": 50.0, "state_saved_pct": 50.0}
    sent = {"prompt_tokens": 100.0, "state_tokens": 100.0}
    return result("tokens", {"llm": dict.fromkeys(sent, kept) | saved, "llm_all": sent | saved})


def tokens(prompt: float, state: float) -> Result:
    counts = {"prompt_uncompressed": 200.0, "prompt_tokens": 150.0, "state_uncompressed": 80.0, "state_tokens": 40.0}
    return result("tokens", {"llm": {"prompt_saved_pct": prompt, "state_saved_pct": state, **counts}})


def fair(served: float, scheduled: float) -> Result:
    return result("fairness", {"llm": {"jain": served, "jain_scheduled": scheduled}, "random": {"jain": 0.73}})


@pytest.mark.parametrize(
    ("stated", "made", "verdict"),
    [
        ("AIC-VDS loses nothing from step 4", flown(llm=4), REPRODUCED),
        ("AIC-VDS loses nothing from step 4", flown(llm=1), REPRODUCED),
        ("AIC-VDS loses nothing from step 4", flown(llm=5), NOT),
        ("AIC-VDS loses nothing from step 4", flown(llm=30), NOT),
        ("EOF reaches zero", flown(eof=18), REPRODUCED),
        ("EOF reaches zero", flown(eof=30), NOT),
        ("EOF reaches zero", flown(eof=3), NOT),
        ("WQCS reaches zero", flown(wqcs=24), REPRODUCED),
        ("WQCS reaches zero", flown(wqcs=25), NOT),
        ("MADQN reaches zero", flown(madqn_paper=27), REPRODUCED),
        ("MADQN reaches zero", flown(madqn_paper=10), NOT),
        ("loses less than EOF", flown(llm=4, eof=20, wqcs=20, madqn_paper=27, mappo=9), REPRODUCED),
        ("loses less than EOF", flown(llm=24, eof=20, wqcs=28, madqn_paper=29, mappo=30), NOT),
        ("halves the prompt", tokens(50.0, 70.0), REPRODUCED),
        ("halves the prompt", tokens(25.0, 50.0), NOT),
        ("only the state block", tokens(25.0, 50.0), REPRODUCED),
        ("only the state block", tokens(25.0, 30.0), NOT),
        ("halves the prompt", beside_unattended(50.0), REPRODUCED),
        ("halves the prompt", beside_unattended(60.0), NOT),
        ("only the state block", beside_unattended(60.0), NOT),
        ("213.7 tokens become 106.8", tokens(50.0, 50.0), APART),
        ("Jain's index", fair(0.985, 0.979), REPRODUCED),
        ("Jain's index", fair(0.87, 0.91), NOT),
        ("Jain's index", fair(0.87, 0.99), APART),
        ("with and without attention", attended(50.0, 50.0), REPRODUCED),
        ("with and without attention", attended(50.0, 90.0), NOT),
        ("k=3 is worse", by_k(k3=80.0, k5=50.0), REPRODUCED),
        ("k=3 is worse", by_k(k3=50.0, k5=50.0), NOT),
        ("k above 5", by_k(k5=50.0, k7=50.0, k10=60.0), REPRODUCED),
        ("k above 5", by_k(k5=50.0, k7=50.0, k10=20.0), NOT),
    ],
)
def test_a_statement_is_judged_by_the_numbers(stated: str, made: Result, verdict: Verdict) -> None:
    found = finding(stated, made, losing(llm=10.0, chance=600.0))
    assert found.verdict is verdict, found.why
    assert found.ours and found.why and found.seeds == 30


@pytest.mark.parametrize(
    ("stated", "made"),
    [
        ("with and without attention", attended(50.0, 50.0)),
        ("k=3 is worse", by_k(k3=80.0, k5=50.0)),
        ("k above 5", by_k(k5=50.0, k7=50.0)),
    ],
)
def test_an_llm_no_better_than_chance_is_no_evidence_about_attention(stated: str, made: Result) -> None:
    found = finding(stated, made, losing(llm=600.0, chance=600.0))
    assert found.verdict is APART
    assert "no better than chance" in found.why


def test_uniform_draws_in_the_llms_place_count_before_a_fleet_at_random() -> None:
    models = losing(llm=500.0, chance=400.0, random=600.0)
    assert beats_chance(flown(llm=4), {"llm-models": models}) is False
    assert beats_chance(flown(llm=4), {"llm-models": losing(llm=300.0, chance=400.0)}) is True
    assert beats_chance(flown(llm=4), {}) is None


def test_chance_flown_beside_another_llm_counts_for_nothing() -> None:
    assert beats_chance(flown(llm=4), {"llm-models": losing().model_copy(update={"model": "large.gguf"})}) is None


@pytest.mark.parametrize(
    ("changes", "verdict", "why"),
    [
        ({"quick": True}, None, "quick run"),
        ({"scenario": "stress"}, APART, "scenario stress"),
        ({"curves": {"llm": zero_from(3, steps=12)}}, APART, "missions of 12 steps"),
    ],
)
def test_only_full_runs_in_the_papers_world_are_judged(
    changes: dict[str, Any], verdict: Verdict | None, why: str
) -> None:
    found = finding("AIC-VDS loses nothing", flown(llm=3).model_copy(update=changes))
    assert found.verdict is verdict
    assert why in found.why


def test_claims_without_a_run_or_a_measurement_have_no_verdict() -> None:
    assert all((f.verdict, f.why) == (None, "not run") for f in judge({}))
    assert finding("MADQN reaches zero", flown(eof=20)).why == "not measured: lost_packets_per_step of madqn_paper"
    assert (
        finding("loses less than EOF", flown(llm=4, eof=20)).why
        == "not measured: lost_packets of wqcs, madqn_paper, mappo"
    )
    assert finding("loses less than EOF", flown(llm=24, eof=20)).verdict is NOT


def test_one_experiment_answers_every_claim_for_the_llm_with_its_adapter() -> None:
    lost = {
        "llm": 42.0,
        "k3": 80.0,
        "llm_all": 42.0,
        "llm_chance": 380.0,
        "eof": 176.0,
        "wqcs": 228.0,
        "madqn_paper": 352.0,
        "mappo": 81.0,
    }
    made = result(
        WITH_ADAPTER,
        {name: {"lost_packets": value} for name, value in lost.items()},
        curves={"llm": zero_from(4)},
        sweep=Sweep(label="k", at={"llm": 5.0, "k3": 3.0}),
    )
    found = {finding.stated: finding for finding in judge_with_adapter({WITH_ADAPTER: made})}
    assert {finding.experiment for finding in found.values()} == {WITH_ADAPTER}
    assert found["AIC-VDS loses nothing from step 4"].verdict is REPRODUCED
    assert found["AIC-VDS loses less than EOF, WQCS, MADQN and MAPPO"].verdict is REPRODUCED
    assert found["k=3 is worse than k=5"].verdict is REPRODUCED
    assert found["EOF reaches zero only by step 20"].verdict is None
    assert judge_with_adapter({}) == []


def test_a_verdict_on_few_seeds_is_marked() -> None:
    made = flown(llm=3, eof=20).model_copy(update={"seeds_of": {"llm": list(range(10))}})
    assert finding("AIC-VDS loses nothing", made).few_seeds
    assert not finding("EOF reaches zero", made).few_seeds


@pytest.mark.parametrize(
    ("curve", "step"),
    [
        ([0.0] * 30, 0),
        ([5.0, 3.0, 1.0, 0.2] + [0.0] * 26, 3),
        ([0.0] * 10 + [1.0] * 2 + [0.0] * 18, 12),
        ([1.0] * 27 + [0.0] * 3, 27),
        ([1.0] * 28 + [0.0] * 2, None),
        ([0.0] * 20 + [0.3] * 10, None),
    ],
)
def test_the_step_at_which_a_curve_settles(curve: list[float], step: int | None) -> None:
    assert settled_at(curve) == step


def test_one_late_packet_does_not_reset_it() -> None:
    # In one of twelve worlds, at step 20.
    curve = [5.0, 3.0, 1.0, 0.2] + [0.0] * 16 + [1 / 12] + [0.0] * 9
    assert settled_at(curve) == 3


def test_pairs_are_of_the_worlds_that_both_flew() -> None:
    few = interval(10.0, seeds=2).model_copy(update={"values": [10.0, 30.0]})
    many = interval(0.0).model_copy(update={"values": [float(n) for n in range(30)]})
    made = result("scheduler", {"llm": {"lost_packets": few}, "eof": {"lost_packets": many}}, seeds_of={"llm": [5, 20]})
    assert difference(made, "llm", "eof", "lost_packets").mean == pytest.approx((10 - 5 + 30 - 20) / 2)


def test_nothing_is_a_share_of_nothing() -> None:
    made = result("scheduler", {"llm": {"lost_packets": 3.0}, "eof": {"lost_packets": 0.0}})
    assert difference(made, "llm", "eof", "lost_packets").mean == pytest.approx(3.0)
    with pytest.raises(Unmeasured, match="lost_packets of eof is 0"):
        ratio(made, "llm", "eof", "lost_packets")
