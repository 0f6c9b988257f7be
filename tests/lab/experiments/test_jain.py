"""The formulas of Jain's index compared with random draws."""

from __future__ import annotations

import numpy as np
import pytest

from lab.experiments.jain import expected_by_chance, of_proportional_visits, reached_by_chance
from simulator.records.decision import jain_index

RNG = np.random.default_rng(7)


def drawn(visits: int, sensors: int, at_once: int, times: int = 4_000) -> np.ndarray:
    """Jain's index of each of ``times`` missions whose steps visit ``at_once`` different sensors."""
    order = RNG.random((times, visits // at_once, sensors)).argsort(axis=-1)[:, :, :at_once].reshape(times, -1)
    counts = (order[:, :, None] == np.arange(sensors)).sum(axis=1)
    return np.array([jain_index(row) for row in counts.tolist()])


@pytest.mark.parametrize(("visits", "sensors", "at_once"), [(90, 10, 1), (90, 10, 3), (40, 5, 2)])
def test_the_index_by_chance_matches_draws(visits: int, sensors: int, at_once: int) -> None:
    found = drawn(visits, sensors, at_once)
    assert expected_by_chance(visits, sensors, at_once) == pytest.approx(found.mean(), abs=0.002)


def test_in_the_papers_world_chance_alone_gives_091() -> None:
    assert round(expected_by_chance(90, 10), 2) == 0.91


@pytest.mark.parametrize("at_once", [1, 3])
def test_the_probability_of_the_papers_index_matches_draws(at_once: int) -> None:
    often = (drawn(90, 10, at_once) >= 0.98).mean()
    assert reached_by_chance(0.98, 90, 10, at_once) == pytest.approx(often, abs=0.006)


def test_visits_in_proportion_to_need_are_less_even_than_chance() -> None:
    needs = [jain_index(row) or 0.0 for row in RNG.uniform(2, 8, (4_000, 10)).tolist()]
    assert of_proportional_visits(2, 8, 10) == pytest.approx(np.mean(needs), abs=0.005)
    assert of_proportional_visits(2, 8, 10) < expected_by_chance(90, 10)
