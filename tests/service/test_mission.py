import pytest

from service.mission import Mission
from service.problems import NotFound
from shared.wire import Outcome
from tests.service.making import attended, mission, uav


def decide(m: Mission, number: int, *, step: int = 0, uav_id: int = 0, sensor: int = 1) -> str:
    decision_id = f"{number:032x}"
    m.commit(attended(m, uav(step=step, uav_id=uav_id), step).pending(m, decision_id, sensor, 7))
    return decision_id


def outcome(decision_id: str, cost: float = 0.5, failed: bool = False) -> Outcome:
    return Outcome(decision_id=decision_id, cost=cost, failed=failed)


def test_arrival_rates_are_learned_from_beacons_between_visits() -> None:
    m = mission()
    for step in range(11):
        m.observe(uav(step=step, queue=[3.0 * step, 60.0, 5.0]))
    prior = m.scenario.mean_arrival_rate
    assert m.rates[0] == pytest.approx((2 * prior + 30) / 12)
    # A full queue hides what overflowed, and says nothing.
    assert m.rates[1] == prior
    assert m.rates[2] == pytest.approx(2 * prior / 12)


def test_a_visit_between_two_beacons_spoils_the_estimate() -> None:
    m = mission()
    m.observe(uav(step=0, queue=[50.0, 50.0]))
    decide(m, 1, step=0, sensor=0)
    m.observe(uav(step=1, queue=[55.0, 55.0]))
    assert m.rates[0] == m.scenario.mean_arrival_rate
    assert m.rates[1] == pytest.approx((10 + 5) / 3)


def test_an_old_beacon_is_no_news() -> None:
    m = mission()
    m.observe(uav(step=4, queue=[20.0]))
    before = m.rates.copy()
    m.observe(uav(step=4, queue=[40.0], last_seen=[2]))
    assert (m.rates == before).all()


def test_experiences_grow_by_appending_and_are_compacted_at_once() -> None:
    m = mission(experiences=4)
    texts = []
    for number in range(1, 7):
        m.apply(outcome(decide(m, number, step=number), cost=number / 10))
        texts.append("".join(m.experiences))
    assert all(later.startswith(earlier) for earlier, later in zip(texts[:4], texts[1:4], strict=False))
    assert len(m.experiences) == 3
    assert [line.split()[-1] for line in m.experiences] == ["0.4", "0.5", "0.6"]


def test_no_experiences_when_told_so() -> None:
    m = mission(experiences=0)
    m.apply(outcome(decide(m, 1)))
    assert m.experiences == []


def test_pending_decisions_are_bounded_and_the_forgotten_are_unknown() -> None:
    m = mission()
    ids = [decide(m, number, step=number) for number in range(1, 40)]
    with pytest.raises(NotFound):
        m.find(ids[0])
    assert m.find(ids[-1]) == "pending"
    assert m.apply(outcome(ids[-1])) is not None
    assert m.find(ids[-1]) == "applied"


def test_a_failure_takes_back_only_its_own_visit() -> None:
    m = mission()
    first = decide(m, 1, step=1)
    m.apply(outcome(first))
    second = decide(m, 2, step=5)
    assert m.visits[1] == 5
    m.apply(outcome(second, failed=True))
    assert m.visits[1] == 1


def test_a_decision_outside_the_modules_view_teaches_nothing() -> None:
    m = mission()
    view = attended(m, uav(queue=[10.0, None]))
    m.commit(view.pending(m, "b" * 32, 1, 14))
    assert m.apply(outcome("b" * 32)) is None
