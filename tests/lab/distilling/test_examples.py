"""The examples of recorded flights: targets, rows and experiences."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from lab.distilling.examples import EXPERIENCED, LEARNED, UNLEARNED, failing_signs
from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, write_rollouts
from shared.world.scenario import SCENARIOS
from tests.lab.distilling.conftest import SHORT, examples_in


def test_a_target_has_a_share_for_the_teachers_sensor_and_prefers_the_faster_of_equal_actions(rollouts: Path) -> None:
    missions = examples_in(LEARNED, rollouts)
    assert [len(mission) for mission in missions] == [SHORT.steps * SHORT.uavs] * 3
    fastest = []
    for example in (example for mission in missions for example in mission):
        assert example.target.sum() == pytest.approx(1.0)
        assert len(example.labels) == len(example.sensors) == len(example.target)
        if example.reference >= 0:
            own = np.array(example.sensors) == example.sensors[example.reference]
            assert example.target[own].sum() >= 0.2
            fastest.append(example.target[own].argmax() == own.sum() - 1)
    assert np.mean(fastest) > 0.5


def test_rows_are_shuffled(rollouts: Path) -> None:
    places = {example.reference // 4 for mission in examples_in(LEARNED, rollouts) for example in mission}
    assert {0, 1, 2, 3, 4} <= places


def test_with_experiences_a_target_shuns_the_sensors_that_failed_and_is_else_the_same(tmp_path: Path) -> None:
    world = SCENARIOS["faulty"].model_copy(update={"steps": 7, "dead_radios": 9})
    file = tmp_path / "faulty.jsonl.gz"
    flown = explore(world, 60_000, "planner", policy="wqcs")
    write_rollouts(file, Header(scenario=world, missions=1, behaviour="wqcs"), flown)
    [bare], [experienced] = (examples_in(view, file) for view in (UNLEARNED, EXPERIENCED))
    lengths, shunning = [], 0
    for one, other in zip(bare, experienced, strict=True):
        lengths.append(len(other.text) - len(one.text))
        assert other.text.endswith(one.text)
        assert other.target.sum() == pytest.approx(1.0)
        failing = failing_signs(re.findall(r"\d\D\d[XY]", other.text[: lengths[-1]]))
        shunned = [letter for own, letter in re.findall(r"\d(\D)\d{7}([A-T])", one.text) if own in failing]
        labels = [label for label in one.labels if any(first <= label < chr(ord(first) + 4) for first in shunned)]
        own = np.array([label in labels for label in one.labels])
        if not own.any() or own.all():
            assert np.allclose(other.target, one.target)
            continue
        shunning += 1
        odds, before = (e.target[own].sum() / e.target[~own].sum() for e in (other, one))
        assert odds == pytest.approx(0.15 * before)
    assert shunning > 0
    # Four characters each, and no outcome comes before a UAV's second report.
    assert lengths[:2] == [0, 0]
    assert max(lengths) == 8 * 4
