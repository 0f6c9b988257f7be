import itertools

import numpy as np
import pytest

from service.api.mission_answers import status_of
from service.errors import Conflict, NotFound
from service.mission.decisions import PENDING_PER_UAV
from service.mission.mission import Mission
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance
from shared.wire.schemas import Outcome
from shared.world.step_rule import Action
from tests.support.missions import attended, mission, uav


def decide(m: Mission, number: int, *, step: int = 0, uav_id: int = 0, sensor: int = 1) -> str:
    decision_id = f"{number:032x}"
    m.commit(attended(m, uav(step=step, uav_id=uav_id), step).pending(decision_id, Action(sensor, 7)))
    return decision_id


def outcome(decision_id: str, cost: float = 0.5, failed: bool = False) -> Outcome:
    return Outcome(decision_id=decision_id, cost=cost, failed=failed)


def test_arrival_rates_are_learned_from_beacons_between_visits() -> None:
    m = mission()
    for step in range(11):
        m.observe(uav(step=step, queue=[3.0 * step, 60.0, 5.0]), step)
    prior = m.scenario.mean_arrival_rate
    assert m.records.rates[0] == pytest.approx((2 * prior + 30) / 12)
    # A full queue hides what overflowed, and says nothing.
    assert m.records.rates[1] == prior
    assert m.records.rates[2] == pytest.approx(2 * prior / 12)


def test_a_visit_between_two_beacons_spoils_the_estimate() -> None:
    m = mission()
    m.observe(uav(step=0, queue=[50.0, 50.0]), 0)
    decide(m, 1, step=0, sensor=0)
    m.observe(uav(step=1, queue=[55.0, 55.0]), 1)
    assert m.records.rates[0] == m.scenario.mean_arrival_rate
    assert m.records.rates[1] == pytest.approx((10 + 5) / 3)


def test_an_old_beacon_is_no_news() -> None:
    m = mission()
    m.observe(uav(step=4, queue=[20.0]), 4)
    before = m.records.rates.copy()
    m.observe(uav(step=4, queue=[40.0], last_seen=[2]), 4)
    assert (m.records.rates == before).all()


def test_experiences_grow_by_appending_and_are_compacted_at_once() -> None:
    m = mission(experiences=4)
    texts = []
    for number in range(1, 7):
        m.apply(outcome(decide(m, number, step=number), cost=number / 10))
        texts.append("".join(m.experiences.block))
    assert all(later.startswith(earlier) for earlier, later in itertools.pairwise(texts[:4]))
    assert len(m.experiences.block) == 3
    assert [line.split()[-1] for line in m.experiences.block] == ["0.40", "0.50", "0.60"]


def test_no_experiences_when_told_so() -> None:
    m = mission(experiences=0)
    m.apply(outcome(decide(m, 1)))
    assert m.experiences.block == []


def test_pending_decisions_are_bounded_and_the_forgotten_are_unknown() -> None:
    m = mission()
    ids = [decide(m, number, step=number) for number in range(1, 40)]
    with pytest.raises(NotFound):
        m.pending.find(outcome(ids[0]))
    assert m.pending.find(outcome(ids[-1])) == "pending"
    assert m.apply(outcome(ids[-1])) is not None
    assert m.pending.find(outcome(ids[-1])) == "applied"


def test_a_decision_that_is_forgotten_counts_as_a_visit_for_good() -> None:
    m = mission()
    for step in range(1, 40):
        decide(m, step, step=step)
    assert m.records.confirmed[1] == 39 - PENDING_PER_UAV
    assert len(m.records.state_dict()["open"][1]) == PENDING_PER_UAV


def test_a_failure_takes_back_only_its_own_visit() -> None:
    m = mission()
    first = decide(m, 1, step=1)
    m.apply(outcome(first))
    second = decide(m, 2, step=5)
    assert m.records.visits[1] == 5
    m.apply(outcome(second, failed=True))
    assert m.records.visits[1] == 1


def test_a_decision_outside_the_modules_view_teaches_nothing() -> None:
    m = mission()
    view = attended(m, uav(queue=[10.0, None]))
    m.commit(view.pending("b" * 32, Action(1, 14)))
    assert m.apply(outcome("b" * 32)) is None


def test_a_fleet_whose_uavs_are_steps_apart_still_shares_its_sensors() -> None:
    m = mission()
    for step in range(10):
        decide(m, 1 + step, step=step, uav_id=0, sensor=2)
    for step in range(10):
        assert m.reservations.of_others(step, uav_id=1) == {2}
        decide(m, 100 + step, step=step, uav_id=1, sensor=3)
    assert m.reservations.of_others(0, uav_id=2) == {2, 3}


def test_reservations_are_bounded() -> None:
    m = mission()
    for step in [1_000_000, *range(500)]:
        m.reservations.attempt(step, 0)
        decide(m, step + 1, step=step)
    assert m.reservations.of_others(0, uav_id=1) == frozenset()
    assert m.reservations.of_others(499, uav_id=1) == {1}
    assert len(m.reservations._by_step) == 64
    assert not m.reservations._attempts
    for step in range(1000, 1100):
        m.reservations.attempt(step, 0)
    assert len(m.reservations._attempts) == 64


def test_an_answer_to_an_earlier_attempt_does_not_undo_a_later_one() -> None:
    m = mission()
    slow, fast = m.reservations.attempt(1, 0), m.reservations.attempt(1, 0)
    view = attended(m, uav(step=1), 1)
    m.commit(view.pending("a" * 32, Action(4, 7)), fast)
    with pytest.raises(Conflict):
        m.commit(view.pending("b" * 32, Action(1, 7)), slow)
    assert m.reservations.of_others(1, uav_id=1) == {4}
    assert status_of(m).visits == {4: 1}


@pytest.mark.parametrize("answered", [1, 2])
def test_a_third_attempt_is_later_than_the_first_two_whichever_of_them_is_answered(answered: int) -> None:
    m = mission()
    open_ = [m.reservations.attempt(1, 0) for _ in range(2)]
    view = attended(m, uav(step=1), 1)
    m.commit(view.pending("a" * 32, Action(4, 7)), open_[answered - 1])
    third = m.reservations.attempt(1, 0)
    assert third > max(open_)
    m.commit(view.pending("b" * 32, Action(2, 7)), third)
    with pytest.raises(Conflict):
        m.commit(view.pending("c" * 32, Action(1, 7)), open_[1])
    assert m.reservations.of_others(1, uav_id=1) == {2}


def test_a_uav_that_asks_again_gives_its_first_sensor_back() -> None:
    m = mission()
    decide(m, 1, step=5, sensor=0)
    decide(m, 2, step=5, sensor=1)
    assert m.reservations.of_others(5, uav_id=1) == {1}
    assert status_of(m).visits == {1: 5}


@pytest.mark.parametrize("order", [(1, 2), (2, 1)])
def test_failures_in_any_order_leave_the_last_real_visit(order: tuple[int, int]) -> None:
    m = mission()
    m.apply(outcome(decide(m, 9, step=1)))
    ids = {1: decide(m, 1, step=3), 2: decide(m, 2, step=7)}
    for number in order:
        m.apply(outcome(ids[number], failed=True))
    assert m.records.visits[1] == 1


def test_a_failure_of_a_later_visit_leaves_an_earlier_one_that_is_still_open() -> None:
    m = mission()
    decide(m, 1, step=3)
    m.apply(outcome(decide(m, 2, step=7), failed=True))
    assert m.records.visits[1] == 3


def test_one_uav_that_retries_forgets_only_its_own_decisions() -> None:
    m = mission()
    other = decide(m, 1, uav_id=1, sensor=2)
    for number in range(2, 60):
        decide(m, number, step=number, uav_id=0)
    assert m.pending.find(outcome(other)) == "pending"


def test_a_uav_that_asks_again_and_again_teaches_once_a_step() -> None:
    m = mission(experiences=8)
    ids = [decide(m, number, step=5) for number in range(1, 6)]
    assert [m.apply(outcome(name)) is not None for name in ids] == [False, False, False, False, True]
    assert (m.feedback, len(m.experiences.block)) == (5, 1)
    # It was there all the same.
    assert m.records.visits[1] == 5


def test_new_orders_drop_the_plan_that_was_made_without_them() -> None:
    m = mission()
    assert m.planner is not None
    m.observe(uav(), 0)
    m.planner.plans[0] = np.array([(1, 14), (2, 14)])
    assert m.planner.action(0) == Action(1, 14)
    m.answer_guidance(GuidanceAnswer(guidance=Guidance(max_velocity=5)))
    assert m.planner.action(0) is None
