"""Decisions that are recorded in the states of a policy of their own, and their targets."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from lab.adapter.batches import targets_of
from lab.adapter.records import Record
from lab.adapter.student_flights import flight_of, records_of_flights
from shared.world.scenario import SCENARIOS
from shared.world.step_rule import Action

_SCENARIO = SCENARIOS["paper"].model_copy(update={"steps": 3})


class _AtFullSpeed:
    """Collects from the sensor that attention scores highest, at the fastest of four velocities."""

    def of(self, records: Sequence[Record], k: int) -> list[Action]:
        return [Action(int(own["ids"][0]), int(own["vel"][0][3])) for own in records]


def test_each_decision_of_missions_side_by_side_is_recorded() -> None:
    records = records_of_flights(_SCENARIO, [3, 4], _AtFullSpeed())

    decisions = len(records) / 2
    assert decisions <= _SCENARIO.steps * _SCENARIO.uavs
    for own in records:
        assert own["mission"] in (3, 4)
        assert own["lost"][: own["n"]].max() < 1e4
    assert [own["mission"] for own in records[:2]] == [3, 4]


def test_the_states_are_those_of_the_flown_actions() -> None:
    def fleet_after(velocity: int) -> list[list[int]]:
        flight = flight_of(_SCENARIO, 3)
        record, seen = next(flight), []
        try:
            while True:
                seen.append(record["rows"].tolist())
                record = flight.send(Action(int(record["ids"][0]), velocity))
        except StopIteration:
            return seen

    slow, fast = fleet_after(0), fleet_after(14)
    assert slow[0] == fast[0]
    assert slow[-1] != fast[-1]


def _targets(lost: list[list[float]], planned: int | None = None, failing: int | None = None) -> torch.Tensor:
    """Targets of two sensors at 0, 7 and 14 m/s each; the planner's option is counted through both."""
    is_planned = torch.zeros(1, 2, 3, dtype=torch.bool)
    if planned is not None:
        is_planned.view(-1)[planned] = True
    fails = torch.zeros(1, 2, dtype=torch.long)
    if failing is not None:
        fails[0, failing] = 1
    velocities = torch.tensor([[[0, 7, 14], [0, 7, 14]]])
    return targets_of(torch.tensor([lost]), velocities, is_planned, fails)[0]


def test_of_options_that_lose_alike_the_faster_is_the_likelier_target() -> None:
    found = _targets([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert found.sum().item() == pytest.approx(1.0)
    assert (found.diff(dim=1) > 0).all()


def test_a_slower_option_that_loses_less_is_the_target() -> None:
    assert _targets([[0.0, 2.0, 2.0], [2.0, 2.0, 2.0]]).argmax().item() == 0


def test_the_planners_sensor_has_its_share_at_the_velocity_that_loses_least() -> None:
    without, found = _targets([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), _targets([[0.0] * 3, [0.0] * 3], planned=3)
    assert without.sum(1).tolist() == pytest.approx([0.5, 0.5])
    assert found.sum(1).tolist() == pytest.approx([0.4, 0.6])
    assert found[1].argmax().item() == 2


def test_a_sensor_that_failed_last_has_a_small_share() -> None:
    assert _targets([[0.0] * 3, [0.0] * 3], failing=0).sum(1).tolist() == pytest.approx([0.13, 0.87], abs=0.01)
