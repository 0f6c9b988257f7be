"""Stored flights: flown once, stored whole, shared between experiments, flown again after a broken file."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from lab.experiments.flight import FlightStore, flight_key
from lab.experiments.plan import weights_of
from lab.experiments.schemes import BOUND, OFF, Scheme, at_full_speed, llm, local, over_edge
from lab.marl import learned
from shared.world.scenario import Scenario
from simulator.flying.flight import rollout
from simulator.policies.registry import policy_named
from simulator.sites.site import Site
from simulator.world.gain_trace import GainTrace
from simulator.world.observation import Observation
from tests.support.tiny_flights import TINY, declared, flown, run_in


def flights_in(out: Path) -> dict[str, int]:
    """The time of modification of every flight's file."""
    return {path.name: path.stat().st_mtime_ns for path in (out / "flights").glob("*.json.gz")}


def test_a_stored_flight_is_loaded_unchanged(tmp_path: Path) -> None:
    store, flight = FlightStore(tmp_path), flown(failures=[1, 2, 0], lost_packets=[0, 3, 9])
    assert store.load("key") is None
    store.save("key", flight)
    assert store.load("key") == flight


@pytest.mark.parametrize(
    "content", [b"", b"not gzip", gzip.compress(b'{"seed": 1}', mtime=0), gzip.compress(b"{}" * 500, mtime=0)[:30]]
)
def test_a_broken_file_is_no_flight(tmp_path: Path, content: bytes) -> None:
    store = FlightStore(tmp_path)
    store.path("key").write_bytes(content)
    assert store.load("key") is None


def test_a_schemes_name_is_no_part_of_the_key() -> None:
    site = Site(TINY)
    renamed = llm().model_copy(update={"name": "k5", "label": "k = 5"})
    assert flight_key(llm(), "embedded", site, 0) == flight_key(renamed, "embedded", site, 0)


def test_decider_site_and_seed_are_part_of_the_key() -> None:
    traced = Site(TINY, np.zeros((3, 10), dtype=np.int64))
    measured = [Site(TINY, gains=GainTrace({(0, 1): (np.zeros(1), np.full(1, loss))})) for loss in (3.0, 4.0)]
    keys = {
        flight_key(llm(), "embedded", Site(TINY), 0),
        flight_key(llm(), "embedded", Site(TINY), 1),
        flight_key(llm(), "another model", Site(TINY), 0),
        flight_key(over_edge("llm", "", top_k=3), "embedded", Site(TINY), 0),
        flight_key(over_edge("llm", "", deadline_ms=None), "embedded", Site(TINY), 0),
        flight_key(llm(), "embedded", Site(Scenario(steps=4)), 0),
        flight_key(llm(), "embedded", traced, 0),
        *(flight_key(llm(), "embedded", site, 0) for site in measured),
        flight_key(local("eof"), None, Site(TINY), 0),
        flight_key(at_full_speed("longest_queue"), None, Site(TINY), 0),
    }
    assert len(keys) == 11


def test_a_stored_flight_is_the_rollout_of_its_policy(tmp_path: Path) -> None:
    [result] = run_in(tmp_path).make([declared()])
    tallies = [rollout(Site(TINY).world(), policy_named("eof"), seed) for seed in range(3)]
    assert result.schemes["eof"]["lost_packets"].values == [sum(t.lost_packets for t in ts) for ts in tallies]
    assert result.schemes["eof"]["events"].values == [sum(t.events for t in ts) for ts in tallies]


def test_experiments_share_flights_and_a_second_run_flies_nothing(tmp_path: Path) -> None:
    run_in(tmp_path).make([declared(name="one")])
    before = flights_in(tmp_path)
    assert len(before) == 6
    run_in(tmp_path).make([declared(local("random"), local("wqcs"), name="two", references=("random",))])
    after = flights_in(tmp_path)
    assert len(after) == 9
    assert before.items() <= after.items()


def test_a_run_flies_only_the_schemes_that_are_chosen(tmp_path: Path) -> None:
    run = run_in(tmp_path, only=("random",))
    (result,) = run.make([declared()])
    assert list(result.schemes) == ["random"]
    assert run.flown == 3


def test_only_a_broken_flight_is_flown_again(tmp_path: Path) -> None:
    first = run_in(tmp_path).make([declared()])
    before = flights_in(tmp_path)
    broken = sorted(before)[2]
    (tmp_path / "flights" / broken).write_bytes(b"\x1f\x8b torn")
    again = run_in(tmp_path).make([declared()])
    after = flights_in(tmp_path)
    assert {name for name in after if after[name] != before[name]} == {broken}
    assert [r.schemes for r in again] == [r.schemes for r in first]


def test_the_same_flights_give_the_same_files(tmp_path: Path) -> None:
    run_in(tmp_path).make([declared()])
    files = ["tiny/results.json", "tiny/results.csv"]
    before = [(tmp_path / name).read_bytes() for name in files]
    run_in(tmp_path).make([declared()])
    assert [(tmp_path / name).read_bytes() for name in files] == before


@pytest.mark.long
def test_two_processes_give_the_flights_of_one(tmp_path: Path) -> None:
    alone = run_in(tmp_path / "one").make([declared()])
    pair = run_in(tmp_path / "two")
    pair.workers = 2
    together = pair.make([declared()])
    assert [r.schemes for r in together] == [r.schemes for r in alone]


def test_a_scheme_that_cannot_fly_is_left_out_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Untrained:
        def reset(self, scenario: Scenario, seed: int) -> None:
            raise ValueError("trained for 4 sensors, this world has 10")

        def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
            raise AssertionError("it cannot fly")

    monkeypatch.setattr(learned, "madqn", Untrained)
    [result] = run_in(tmp_path).make([declared(local("eof"), local("madqn"))])
    assert list(result.schemes) == ["eof"]
    assert any("MADQN on paper cannot fly: trained for 4 sensors" in note for note in result.notes)


def test_full_speed_changes_the_velocity_alone(tmp_path: Path) -> None:
    run = run_in(tmp_path, seeds=1)
    run.make(
        [
            declared(
                local("longest_queue"), at_full_speed("longest_queue"), measures=("velocity", "lost_packets", "events")
            )
        ]
    )
    store = FlightStore(tmp_path / "flights")
    own, full = (
        store.load(flight_key(s, None, Site(TINY), 0)) for s in (local("longest_queue"), at_full_speed("longest_queue"))
    )
    assert own is not None and full is not None
    assert {d.velocity for d in own.decisions} == {7} and {d.velocity for d in full.decisions} == {14}
    assert [d.sensor for d in own.decisions[:3]] == [d.sensor for d in full.decisions[:3]]


def test_schemes_without_an_llm_are_recognised() -> None:
    schemes: list[tuple[Scheme, bool]] = [
        (llm(), True),
        (over_edge("x", "", mode="value", backing=OFF), False),
        (local("eof"), False),
    ]
    assert [scheme.asks_llm for scheme, _ in schemes] == [asks for _, asks in schemes]


def test_a_network_trained_anew_is_another_scheme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights_of.cache_clear()
    monkeypatch.setattr("lab.experiments.plan.files", lambda package: tmp_path)
    assert weights_of("eof") is None
    (tmp_path / "checkpoints").mkdir()
    hashes = set()
    for content in (b"first", b"second"):
        (tmp_path / "checkpoints" / "madqn.pt").write_bytes(content)
        weights_of.cache_clear()
        hashes.add(weights_of("madqn"))
    weights_of.cache_clear()
    assert len(hashes) == 2 and None not in hashes


@pytest.mark.long
def test_planners_fly_in_a_process_of_their_own_and_none_undercuts_the_bound(tmp_path: Path) -> None:
    [result] = run_in(tmp_path, seeds=2).make([declared(local("eof"), local("mpc"), BOUND)])
    least = result.bound["lost_packets"].values
    for scheme in ("eof", "mpc"):
        lost = result.schemes[scheme]["lost_packets"].values
        assert all(low <= value for low, value in zip(least, lost, strict=True)), scheme
    assert not any("wrong" in note or "cannot fly" in note for note in result.notes)
