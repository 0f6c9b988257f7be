"""Feature preset ``reach``: what a UAV on its lap could collect after a step at each velocity."""

import math

import numpy as np
import pytest

from service.api.mission_answers import status_of
from service.deciding.attended_state import AttendedState
from shared.features.augmented_state import FEATURES, LEVEL_FEATURES, distances_between, places_ahead
from shared.wire.schemas import Features, MissionSpec, UavState
from shared.world.channel import link_holds, packets_per_step
from shared.world.scenario import SCENARIOS, Point
from shared.world.trajectory import trajectories
from tests.support.missions import PAPER, attended, mission, uav, written_rows

PATH = trajectories(PAPER)[0]
REACH = MissionSpec(features="reach")


def on_lap(places: list[Point], queue: list[float | None], *, step: int = 0, reported: bool = True) -> UavState:
    """UAV 0 at the beginning of its lap, and sensors at these places."""
    x, y = PATH.at(0.0).tolist()
    state = uav(step=step, position=(x, y), x=[place[0] for place in places], queue=queue)
    sensors = state.sensors.model_copy(update={"y": [place[1] for place in places]})
    return state.model_copy(update={"sensors": sensors, "progress_m": 0.0 if reported else None})


def at(progress: float) -> Point:
    x, y = PATH.at(progress).tolist()
    return x, y


def seen(state: UavState, spec: MissionSpec = REACH, step: int = 0) -> AttendedState:
    return attended(mission(spec), state, step)


@pytest.mark.parametrize("reported", [True, False])
def test_distances_are_those_of_the_world_after_the_step(reported: bool) -> None:
    view = seen(on_lap([at(480.0), at(-300.0)], [60.0, 60.0], reported=reported))
    assert view.state.reach is not None
    for velocity in range(15):
        arrived = PATH.at(velocity * PAPER.step_s)
        for sensor, progress in enumerate((480.0, -300.0)):
            expected = math.dist(arrived, at(progress))
            assert view.state.reach.links.distance[velocity, sensor] == pytest.approx(expected)


def test_a_route_there_and_back_is_followed_the_way_that_the_uav_says() -> None:
    routed = PAPER.model_copy(update={"uavs": 1, "routes": (((0.0, 0.0), (1000.0, 0.0)),)})
    places = np.array([[1000.0, 0.0]])
    out, back = (
        distances_between(places_ahead(0, (500.0, 0.0), reported, routed), places)[14, 0]
        for reported in (500.0, 1500.0)
    )
    assert (out, back) == (pytest.approx(360.0), pytest.approx(640.0))


def test_packets_are_at_most_the_queue_and_what_the_channel_moves() -> None:
    view = seen(on_lap([at(480.0), at(0.0), at(0.0)], [60.0, 7.0, 60.0]))
    reach = view.state.reach
    assert reach is not None
    moved = packets_per_step(reach.links.distance, PAPER)
    np.testing.assert_array_equal(reach.packets, np.minimum([60.0, 7.0, 60.0], moved))
    assert reach.packets[0, 0] == 0 < reach.packets[14, 0]
    assert reach.packets[0, 1] == 7


def test_the_best_velocity_is_the_fastest_that_still_collects_an_urgent_queue() -> None:
    view = seen(on_lap([at(-300.0), at(480.0), at(0.0)], [60.0, 60.0, 0.0]))
    reach = view.state.reach
    assert reach is not None
    behind, ahead, empty = reach.best.tolist()
    assert 0 <= behind < 14
    assert link_holds(reach.links.distance[behind, 0], PAPER)
    assert link_holds(reach.links.distance[ahead, 1], PAPER)
    assert empty == 14
    assert reach.best_packets[2] == 0


def test_a_uav_off_its_trajectory_has_its_present_position_at_every_velocity() -> None:
    reach = seen(uav()).state.reach
    assert reach is not None
    np.testing.assert_allclose(reach.links.distance, np.tile([0.0, 100.0, 200.0, 300.0, 400.0, 500.0], (15, 1)))
    assert (reach.best == 14).all()


def test_nothing_can_be_moved_from_a_sensor_unheard_or_flat() -> None:
    state = on_lap([at(0.0)] * 3, [60.0, None, 60.0])
    sensors = state.sensors.model_copy(update={"battery": [50.0, None, 0.0]})
    reach = seen(state.model_copy(update={"sensors": sensors})).state.reach
    assert reach is not None
    assert reach.packets.any(axis=0).tolist() == [True, False, False]


def test_the_papers_five_come_first_and_everything_lies_between_zero_and_one() -> None:
    state = on_lap([at(480.0), at(-300.0), at(100.0), (900.0, 100.0)], [60.0, 30.0, 12.0, 60.0], step=4)
    paper, reach = (seen(state, MissionSpec(features=preset), 4).state for preset in _presets())
    features = reach.features(PAPER)
    assert features.shape == (4, FEATURES["reach"])
    np.testing.assert_array_equal(features[:, :5], paper.features(PAPER))
    assert features.min() >= 0
    assert features.max() <= 1
    assert paper.reach is None
    assert reach.reach is not None
    added, urgent = features[:, 5:], reach.urgency * reach.reach.best_packets / 60
    np.testing.assert_allclose(added[:, 0], reach.reach.best_packets / 60, rtol=1e-6)
    np.testing.assert_allclose(added[:, 1], urgent, rtol=1e-6)
    np.testing.assert_allclose(added[:, 2], reach.reach.best / 14, rtol=1e-6)
    # No beacon but the first: the rate is the scenario's mean.
    np.testing.assert_allclose(added[:, 3], (60 - reach.queue) / 5.0 / 30, rtol=1e-6)
    assert added[:, 4].tolist() == link_holds(reach.distance, PAPER).tolist()
    assert added[:, 5].tolist() == link_holds(reach.reach.links.distance[14], PAPER).tolist()
    np.testing.assert_allclose(added[:, 6], reach.distance / 360 / 2, rtol=1e-6)


def test_a_sensor_that_nothing_arrives_at_never_overflows() -> None:
    silent = PAPER.model_copy(update={"arrival_rate_min": 0.0, "arrival_rate_max": 0.0})
    features = seen(on_lap([at(0.0)], [60.0]), MissionSpec(scenario=silent, features="reach")).state.features(silent)
    assert np.isfinite(features).all()
    assert features[0, 8] == 1.0


def test_the_velocity_scorer_is_told_what_each_level_brings() -> None:
    state = seen(on_lap([at(-300.0), at(480.0)], [60.0, 45.0])).state
    reported = state.approaches([1], PAPER)[0]
    assert reported.shape == (15, LEVEL_FEATURES)
    assert state.reach is not None
    np.testing.assert_allclose(reported[:, 0], state.reach.packets[:, 1] / 60, rtol=1e-6)
    np.testing.assert_allclose(reported[:, 1], state.urgency[1] * state.reach.packets[:, 1] / 60, rtol=1e-6)
    np.testing.assert_allclose(reported[:, 2], np.arange(15) / 14, rtol=1e-6)
    np.testing.assert_allclose(reported[:, 3], np.minimum(state.reach.links.distance[:, 1] / 360, 2), rtol=1e-6)


def test_the_shipped_start_slows_down_for_a_full_queue_and_hurries_past_an_empty_one() -> None:
    m = mission(REACH)
    full, little = (attended(m, on_lap([at(-300.0)], [queue])).best_by_value()[1] for queue in (60.0, 1.0))
    assert link_holds(math.dist(PATH.at(10.0 * full), at(-300.0)), PAPER)
    assert little > full


def test_a_row_tells_the_best_velocity_and_what_it_collects() -> None:
    state = on_lap([at(-300.0), at(480.0)], [60.0, None])
    m = mission(REACH)
    view = attended(m, state)
    assert view.state.reach is not None
    best, movable = int(view.state.reach.best[0]), int(view.state.reach.best_packets[0])
    prompt = m.template.prompt(view.state, view.shown(), [])
    assert ",UrgencyScore,OverflowProb,BestVelocity,Collectable\n" in prompt.static
    assert prompt.state.endswith(f",{best},{movable}\n")
    known, unknown = written_rows(view.state)
    assert known.startswith("0,60,50,-90,")
    assert unknown.endswith(",?,?\n")
    plain = mission().template.static
    assert ",UrgencyScore,OverflowProb\n" in plain and "Collectable" not in plain


@pytest.mark.parametrize("scenario", sorted(SCENARIOS))
def test_every_scenario_flies_with_it(scenario: str) -> None:
    m = mission(MissionSpec(scenario=scenario, features="reach"))
    view = attended(m, uav())
    sensor, velocity = view.best_by_value()
    assert sensor in range(6)
    assert 0 <= velocity <= 14
    assert status_of(m).features == "reach"


def _presets() -> tuple[Features, Features]:
    return "paper", "reach"
