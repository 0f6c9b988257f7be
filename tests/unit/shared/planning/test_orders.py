"""Guidance: what is taken, what it asks for in numbers, and that plans obey it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from shared.belief.fleet_belief import FleetBelief
from shared.planning.fleet_problem import FleetProblem, with_fixed
from shared.planning.greedy import look_ahead
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import LATE_PACKETS, NO_GUIDANCE, End, Guidance, Impossible, SensorWish
from shared.planning.receding import RecedingHorizon
from shared.world.scenario import SCENARIOS
from tests.unit.shared.planning.test_fleetplan import changed, tiny

PAPER = SCENARIOS["paper"]
LEAK = Guidance(sensors=[SensorWish(sensor_id=4, visit_every=3, weight=2.0)], max_velocity=10)


def test_guidance_that_asks_for_nothing_is_false() -> None:
    assert not NO_GUIDANCE
    assert not Guidance(sensors=[SensorWish(sensor_id=3)])
    assert LEAK and Guidance(min_velocity=0) and Guidance(sensors=[SensorWish(sensor_id=3, weight=0)])


@pytest.mark.parametrize(
    ("guidance", "field"),
    [
        (Guidance(sensors=[SensorWish(sensor_id=1), SensorWish(sensor_id=10, weight=2)]), "sensors[1].sensor_id"),
        (Guidance(min_velocity=9, max_velocity=8), "forbidden_velocities"),
        (Guidance(forbidden_velocities=list(range(15))), "forbidden_velocities"),
        (Guidance(max_velocity=9, ends={"max_velocity": End(visited=10)}), "ends.max_velocity.visited"),
    ],
)
def test_what_a_fleet_cannot_obey_is_named(guidance: Guidance, field: str) -> None:
    with pytest.raises(Impossible) as caught:
        guidance.check(PAPER)
    assert caught.value.field == field


def test_a_velocity_past_the_fleets_is_named() -> None:
    with pytest.raises(Impossible, match="max_velocity: 9 m/s is more than the fleet's highest, 5 m/s"):
        Guidance(max_velocity=9).check(PAPER.model_copy(update={"max_velocity": 5}))


@pytest.mark.parametrize(
    "wrong",
    [
        {"sensors": [{"sensor_id": 1, "weight": 10.5}]},
        {"sensors": [{"sensor_id": 1, "weight": -1}]},
        {"sensors": [{"sensor_id": 1, "visit_every": 0}]},
        {"sensors": [{"sensor_id": 1}, {"sensor_id": 1}]},
        {"max_velocity": 15},
        {"max_velocity": 7.5},
        {"speed": 3},
    ],
)
def test_a_structure_out_of_range_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Guidance.model_validate(wrong)


def test_an_answer_is_a_word_or_a_structure() -> None:
    assert GuidanceAnswer(answer="confirm").guidance is None
    wrongs: list[dict[str, Any]] = [{}, {"answer": "confirm", "guidance": {}}, {"answer": "maybe"}]
    wrongs += [{"answer": "reject", "change": "add"}, {"answer": "confirm", "orders": ["visit:4"]}]
    wrongs += [{"answer": "withdraw", "orders": names} for names in ([], ["x" * 81])]
    for wrong in wrongs:
        with pytest.raises(ValidationError):
            GuidanceAnswer.model_validate(wrong)


def test_velocities_between_the_limits_and_not_forbidden_are_allowed() -> None:
    guidance = Guidance(min_velocity=2, max_velocity=6, forbidden_velocities=[4])
    assert np.flatnonzero(guidance.allowed(15)).tolist() == [2, 3, 5, 6]
    assert guidance.allows(5) and not guidance.allows(4) and not guidance.allows(14)
    assert [guidance.nearest(v, 15) for v in (0, 4, 5, 14)] == [2, 3, 5, 6]
    assert NO_GUIDANCE.allowed(15).all() and NO_GUIDANCE.nearest(11, 15) == 11


def test_a_sensor_is_overdue_in_the_step_in_which_it_must_be_visited() -> None:
    visits = np.full(10, 7)
    assert [LEAK.overdue(step, visits)[4] for step in (8, 9, 10, 11)] == [0, 0, 1, 2]
    assert not LEAK.overdue(500, visits)[:4].any()
    # Never visited: one of the first three steps must.
    assert [LEAK.overdue(step, np.full(10, -1))[4] for step in (1, 2)] == [0, 1]


def test_lateness_is_paid_for_each_late_step_and_less_after_a_later_visit() -> None:
    visits = np.full(10, 7)
    late = LEAK.lateness(8, visits, horizon=4, beyond=2)
    # The plan's steps are 8, 9, 10, 11, and beyond them 12 and 13.
    assert late[0, :, 4].tolist() == [0, 0, LATE_PACKETS, LATE_PACKETS, 2 * LATE_PACKETS]
    # Visited in the plan's step 1, that is in 9: due in 12.
    assert late[2, 2:, 4].tolist() == [0, 0, 2 * LATE_PACKETS]
    # Visited in its last step, in 11: due in 14.
    assert late[4, 4, 4] == 0
    for now in range(5):
        assert (np.diff(late[: now + 1, now, 4]) <= 0).all()
    assert not np.delete(late, 4, axis=2).any()


def test_it_is_read_back_from_the_structure() -> None:
    assert LEAK.in_words() == (
        "Visit sensor 4 at least once in every 3 steps. Count each packet that sensor 4 loses 2 times. "
        "Never fly faster than 10 m/s."
    )
    assert Guidance(forbidden_velocities=[7, 2], min_velocity=1).in_words() == (
        "Never fly slower than 1 m/s. Never fly at 2 m/s. Never fly at 7 m/s."
    )
    assert NO_GUIDANCE.in_words() == "Nothing beyond the mission's own rules."


def test_an_order_has_a_name_and_may_have_an_end() -> None:
    ends = {"visit:4": End(step=40), "weight:4": End(steps=10), "max_velocity": End(visited=2)}
    guidance = LEAK.model_copy(update={"ends": ends})
    assert guidance.each_in_words() == {
        "visit:4": "Visit sensor 4 at least once in every 3 steps, until step 40.",
        "weight:4": "Count each packet that sensor 4 loses 2 times, for 10 steps.",
        "max_velocity": "Never fly faster than 10 m/s, until sensor 2 was visited.",
    }
    assert guidance.without({"weight:4"}).each_in_words().keys() == {"visit:4", "max_velocity"}
    once = {"sensors": [{"sensor_id": 4, "visit_every": 1}], "ends": {"visit:4": {"visited": 4}}}
    assert Guidance.model_validate(once).in_words() == "Visit sensor 4 once, as soon as possible."
    clock = End.model_validate_json('{"time": "2030-05-01T14:30:00+02:00"}')
    assert str(clock) == "until 2030-05-01 14:30+02:00"
    assert End.model_validate(clock.model_dump(mode="json")) == clock
    # An older reader of a structure without ends sees none.
    assert "ends" not in LEAK.model_dump()


@pytest.mark.parametrize(
    "wrong",
    [{"visit:4": {}}, {"visit:4": {"step": 3, "steps": 3}}, {"visit:3": {"step": 3}}, {"4": {"step": 3}}],
)
def test_an_end_is_one_and_that_of_an_order(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Guidance.model_validate({"sensors": [{"sensor_id": 4, "visit_every": 3}], "ends": wrong})


def words(*wishes: dict[str, float], **velocities: Any) -> Guidance:
    return Guidance.model_validate({"sensors": list(wishes), **velocities})


@pytest.mark.parametrize(
    ("in_force", "added", "left"),
    [
        # Another sensor, or another kind of order: both stay.
        (words({"sensor_id": 4, "visit_every": 3}), words({"sensor_id": 2, "visit_every": 5}), {"visit:4", "visit:2"}),
        (words({"sensor_id": 4, "visit_every": 3}), words({"sensor_id": 4, "weight": 5.0}), {"visit:4", "weight:4"}),
        (words(min_velocity=2), words(max_velocity=8), {"min_velocity", "max_velocity"}),
        (words(forbidden_velocities=[0]), words(forbidden_velocities=[7]), {"avoid:0", "avoid:7"}),
        # A visit of a sensor that is ignored.
        (words({"sensor_id": 4, "visit_every": 3}), words({"sensor_id": 4, "weight": 0.0}), {"weight:4"}),
        (words({"sensor_id": 4, "weight": 0.0}), words({"sensor_id": 4, "visit_every": 3}), {"visit:4"}),
        # Velocities of which none is left: only the one in the way ends.
        (words(max_velocity=5, forbidden_velocities=[0]), words(min_velocity=8), {"avoid:0", "min_velocity"}),
        (
            words(min_velocity=5, max_velocity=6),
            words(forbidden_velocities=[5, 6]),
            {"max_velocity", "avoid:5", "avoid:6"},
        ),
    ],
)
def test_an_added_order_replaces_only_what_it_contradicts(in_force: Guidance, added: Guidance, left: set[str]) -> None:
    both = added.added_to(in_force, 15)
    assert both.values.keys() == left
    assert {name: both.values[name] for name in added.values} == added.values


def test_an_added_order_of_the_same_name_takes_its_end_along() -> None:
    until = LEAK.model_copy(update={"ends": {"max_velocity": End(step=9)}})
    assert until.added_to(LEAK, 15).ends == until.ends
    assert LEAK.added_to(until, 15).ends == {}
    with pytest.raises(Impossible, match="sensors"):
        every = [Guidance(sensors=[SensorWish(sensor_id=i + n, visit_every=2) for i in range(600)]) for n in (0, 600)]
        every[1].added_to(every[0], 15)


def test_the_quick_plan_flies_what_is_allowed_and_goes_where_it_is_late() -> None:
    problem = tiny(1, horizon=4)
    slow = changed(problem, allowed=np.array([True, False, False]))
    assert (look_ahead(slow)[..., 1] == 0).all()
    visited = {int(s) for s in look_ahead(problem)[0, :, 0]}
    neglected = next(j for j in range(3) if j not in visited)
    late = np.zeros((5, 5, 3))
    late[0, :, neglected] = 1000.0
    reach = [problem.distance(uav, np.arange(3))[:, neglected].min() for uav in range(2)]
    assert min(reach) < problem.scenario.radio_radius_m
    assert neglected in look_ahead(changed(problem, late=late))[0, :, 0]


def test_an_earlier_plan_gives_way_to_what_is_allowed_now() -> None:
    problem = tiny(2, horizon=3)
    before = np.zeros((3, 2, 2), dtype=np.int64)
    before[..., 1] = 2
    asked = changed(problem, allowed=np.array([True, True, False]))
    assert (with_fixed(asked, before)[..., 1] <= 1).all()


def heard(seed: int) -> tuple[FleetBelief, RecedingHorizon]:
    """Three UAVs at the start of their laps, all sensors heard."""
    belief = FleetBelief(PAPER)
    rng = np.random.default_rng(seed)
    places = rng.uniform(200, 800, (10, 2))
    for uav in range(3):
        belief.locate(uav, 0, belief.trajectory(uav).at(0.0).tolist(), 0.0)
    belief.hear(np.arange(10), places, np.zeros(10, dtype=np.int64), np.full(10, 30.0), np.full(10, 50.0))
    return belief, RecedingHorizon(PAPER, belief)


def flown(guidance: Guidance, seed: int = 0) -> np.ndarray:
    """A plan's actions ``(H, I, 2)``."""
    _, horizon = heard(seed)
    horizon.guidance = guidance
    horizon.begin(0)
    draft = horizon.draft([0, 1, 2])
    assert draft is not None
    found = draft.search()
    horizon.adopt(draft, found)
    return np.stack([horizon.plans[uav] for uav in range(3)], axis=1)


def test_the_fleets_plan_keeps_a_deadline_and_the_velocities() -> None:
    free = flown(NO_GUIDANCE, seed=1)
    # All sensors are in reach, and the free plan leaves these alone at first.
    left = [j for j in range(10) if not (free[:2, :, 0] == j).any()]
    assert left
    for sensor in left:
        guidance = Guidance(sensors=[SensorWish(sensor_id=sensor, visit_every=2)], forbidden_velocities=[14, 0])
        kept = flown(guidance, seed=1)
        visited = (kept[..., 0] == sensor).any(axis=1)
        assert (visited[:-1] | visited[1:]).all(), (sensor, visited)
        assert not np.isin(kept[..., 1], (0, 14)).any()


def test_without_guidance_nothing_reaches_the_problem() -> None:
    _, horizon = heard(0)
    horizon.begin(0)
    draft = horizon.draft([0, 1, 2])
    assert draft is not None
    problem: FleetProblem = draft.problem
    assert problem.allowed is None and problem.weights is None and problem.late is None


def test_the_belief_knows_who_was_visited() -> None:
    belief, _ = heard(0)
    near = int(belief.links(0, [0.0]).packets[0].argmax())
    belief.record_decision(0, 0, near, 0)
    belief.advance(1)
    assert belief.visited[near] == 0
    assert (np.delete(belief.visited, near) == -1).all()
