"""A mission in this process decides as the same mission over an edge, and look-ahead names only sensors kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lab.benchmarks import served_only
from lab.benchmarks.trust import edge
from lab.claims_map import flights
from lab.claims_map.deciders import EdgeDecider, EdgeFleet, look_ahead_among
from service.deciding.attended_state import AttendedState
from shared.world.scenario import SCENARIOS
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 12, "initial_queue_min": 0.9})
REPORTED: dict[str, Any] = {"features": "paper", "belief": "reported", "init": "random"}


def lost_here(spec: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> list[int]:
    monkeypatch.setitem(flights.AT_THE_EDGE, "here", EdgeDecider("value", spec))
    lost: list[int] = flights.fly("here", SHORT, range(2)).lost.sum(axis=1).tolist()
    return lost


@pytest.mark.parametrize("spec", [{}, REPORTED])
def test_mode_value_loses_what_it_loses_over_an_edge(spec: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    here = lost_here(spec, monkeypatch)
    with edge() as (url, _):
        there = [served_only.flown(url, SHORT, seed, f"there-{seed}", {"mode": "value", **spec}) for seed in range(2)]
    assert here == there
    assert sum(here) > 0


def test_a_mission_of_reports_alone_does_not_need_the_belief(monkeypatch: pytest.MonkeyPatch) -> None:
    unfed = lost_here(REPORTED, monkeypatch)
    fed = lambda fleet, request: fleet.mission.observe(request, request.step)  # noqa: E731
    monkeypatch.setattr(EdgeFleet, "observe", fed)
    assert lost_here(REPORTED, monkeypatch) == unfed


def test_look_ahead_chooses_among_the_sensors_that_attention_keeps() -> None:
    fleet = EdgeFleet(EdgeDecider("look_ahead", {"top_k": 1, "init": "random"}), SHORT, 0)
    observations, _ = PipelineWorld(SHORT).reset(seed=0)
    request = decide_request(0, observations["uav_0"], fleet.mission.mission_id)
    fleet.mission.observe(request, 0)
    state = AttendedState.of(fleet.mission, request, 0)
    sensor, velocity = look_ahead_among(state)
    assert [sensor] == state.kept_ids
    assert velocity == int(np.argmax(state.reach.worth[:, state.rows[0]]))


def test_a_sensor_that_another_uav_has_is_not_chosen() -> None:
    fleet = EdgeFleet(flights.AT_THE_EDGE[flights.EVERY_SENSOR], SHORT, 0)
    observations, _ = PipelineWorld(SHORT).reset(seed=3)
    chosen = [fleet.decide(uav, observations[f"uav_{uav}"]).sensor_id for uav in range(3)]
    assert len(set(chosen)) == 3
