import numpy as np
import pytest

from shared.features.augmented_state import FEATURES
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance, SensorWish
from shared.wire.schemas import MissionSpec
from shared.world.channel import channel_gain_db
from shared.world.step_rule import Action
from shared.world.urgency import urgency
from tests.support.missions import PAPER, attended, mission, uav


def test_features_are_the_papers_five_between_zero_and_one() -> None:
    m = mission()
    m.records.visits[2] = 3
    view = attended(m, uav(step=9), step=9)
    state, features = view.state, view.state.features(PAPER)
    assert features.shape == (6, FEATURES["paper"])
    best, worst = float(channel_gain_db(0, PAPER)), -PAPER.path_loss_limit_db
    expected = [1.0, 30 / 60, (-90 - worst) / (best - worst), 6 / 30, urgency([30], [5.0], PAPER)[0]]
    np.testing.assert_allclose(features[2], expected, rtol=1e-6)
    assert state.since_visit.tolist() == [9, 9, 6, 9, 9, 9]


def test_a_stale_gain_is_the_channel_models_from_here() -> None:
    view = attended(mission(), uav(step=5, last_seen=[5, 2, 5, 5, 5, 5]), step=5)
    assert view.state.gain[0] == -90.0
    assert view.state.gain[1] == channel_gain_db(100.0, PAPER)


def test_unheard_and_reserved_sensors_never_reach_the_softmax() -> None:
    m = mission()
    m.commit(attended(m, uav(uav_id=1)).pending("a" * 32, Action(3, 5)))
    view = attended(m, uav(queue=[10.0, None, 20.0, 30.0, None, 40.0]))
    assert sorted(view.kept_ids) == [0, 2, 5]
    assert len(view.state.features(PAPER)) == 3
    # Only this step's reservations count, and only other UAVs'.
    assert 3 in attended(m, uav(step=1), step=1).kept_ids
    assert 3 in attended(m, uav(uav_id=1)).kept_ids


def test_a_sensor_with_a_flat_battery_never_reaches_the_softmax() -> None:
    state = uav(queue=[10.0, 20.0, 30.0])
    sensors = state.sensors.model_copy(update={"battery": [50.0, 0.0, 50.0]})
    assert sorted(attended(mission(), state.model_copy(update={"sensors": sensors})).kept_ids) == [0, 2]


def test_top_k_is_the_missions() -> None:
    view = attended(mission(top_k=2), uav())
    assert len(view.rows) == 2
    scores = mission().learner.weights.attend(view.state.features(PAPER)).scores
    assert view.kept_ids == np.argsort(-scores)[:2].tolist()


def test_the_shipped_start_prefers_a_full_queue_among_sensors_visited_alike() -> None:
    x, y = PAPER.lap_centres[0]
    report = uav(position=(x + PAPER.lap_radius_m, y), x=[x + PAPER.lap_radius_m + 40.0 * i for i in range(6)])
    m = mission(MissionSpec(features="reach"))
    m.observe(report, 0)
    view = attended(m, report)
    assert view.state.queue.argmax() == 5
    assert view.kept_ids[0] == 5


def test_a_sensors_probability_is_the_sum_of_its_answers() -> None:
    view = attended(mission(top_k=2), uav())
    first, second = view.kept_ids
    view.show_probabilities([first, second, first, 99], np.array([0.2, 0.3, 0.4, 0.1]))
    assert [candidate.llm for candidate in view.candidates] == [0.6, 0.3]


def test_orders_add_the_packets_that_they_are_worth_to_a_score_as_shares_of_a_full_queue() -> None:
    m = mission(top_k=6)
    before = {one.sensor_id: one.score for one in attended(m, uav()).candidates}
    m.answer_guidance(GuidanceAnswer(guidance=Guidance(sensors=[SensorWish(sensor_id=2, weight=3.0)])))
    view = attended(m, uav())
    assert view.prompt_view.added is not None and view.state.ids.tolist() == list(range(6))
    assert view.prompt_view.added[2] > 1.0
    for one in view.candidates:
        added = view.prompt_view.added[one.sensor_id] / PAPER.queue_capacity
        assert one.score == pytest.approx(before[one.sensor_id] + added, abs=1e-5)
