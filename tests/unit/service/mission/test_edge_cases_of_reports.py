"""Reports at the limits: nearly flat batteries, large queues, UAVs a step behind, and prompts of many sensors."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from scipy.stats import poisson

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import candidates_of, template_of
from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState
from service.errors import Refused
from service.mission.decisions import Pending
from service.mission.mission import Mission
from shared.belief.fleet_belief import FleetBelief
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance, SensorWish
from shared.planning.receding import RecedingHorizon
from shared.wire.schemas import MissionSpec, Outcome, PromptStyle, SensorColumns, UavState
from shared.world.scenario import Scenario
from shared.world.step_rule import Action, least_joules_a_packet
from shared.world.urgency import overflow_probability

_LINE = ((0.0, 0.0), (1000.0, 0.0))
# Less than a packet costs.
_RESIDUE_J = 0.6


def _world(sensors: int = 2, uavs: int = 1, **changes: Any) -> Scenario:
    return Scenario(name="line", sensors=sensors, uavs=uavs, steps=100, routes=(_LINE,) * uavs, **changes)


def _report(uav: int, step: int, queues: list[float], battery: list[float], at: float = 300.0, **more: Any) -> UavState:
    count = len(queues)
    sensors = SensorColumns(
        id=list(range(count)),
        x=[300.0 + 200.0 * (i % 3) for i in range(count)],
        y=[0.0] * count,
        queue=[*queues],
        battery=[*battery],
        channel_gain=[-85.0] * count,
        last_seen=[step] * count,
    )
    return UavState(uav_id=uav, position=[at, 0.0], progress_m=at, sensors=sensors, **more)


def _mission(scenario: Scenario, mode: str = "policy", **spec: Any) -> Mission:
    settings = Settings(mode="guided", store="none", llm_context=100_000, llm_adapter="served")
    return Mission("m", MissionSpec.model_validate({"scenario": scenario, "mode": mode, **spec}), settings)


@pytest.mark.parametrize("belief", ["fleet", "reported"])
@pytest.mark.parametrize("share", [0.0, _RESIDUE_J])
def test_a_sensor_that_cannot_pay_for_a_packet_is_never_chosen(belief: str, share: float) -> None:
    world = _world()
    left = share * least_joules_a_packet(world)
    mission = _mission(world, "value", belief=belief)
    report = _report(0, 0, [60.0, 20.0], [left, 50.0])
    mission.observe(report, 0)
    assert AttendedState.of(mission, report, 0).admissible == [1]


def test_no_plan_goes_to_a_flat_sensor_whatever_is_ordered() -> None:
    belief = FleetBelief(_world())
    planner = RecedingHorizon(_world(), belief)
    planner.guidance = Guidance(sensors=[SensorWish(sensor_id=0, visit_every=2)])
    planner.begin(0)
    belief.locate(0, 0, (300.0, 0.0), 300.0)
    places, least = np.array([[300.0, 0.0], [500.0, 0.0]]), least_joules_a_packet(_world())
    belief.hear(
        np.arange(2), places, np.zeros(2, dtype=np.int64), np.array([60.0, 20.0]), np.array([_RESIDUE_J * least, 50.0])
    )
    assert belief.battery.tolist() == [0.0, 50.0]
    draft = planner.draft([0])
    assert draft is not None
    assert (draft.search().actions[..., 0] != 0).all()


def test_overflow_is_poissons_for_any_capacity() -> None:
    world = _world(queue_capacity=100_000)
    queue, rate = np.array([0.0, 99_990.0, 99_999.0]), np.array([1.0, 3.0, 2.0])
    mean = rate * world.overflow_horizon_steps
    expected = poisson.sf(world.queue_capacity - queue, mean)
    assert overflow_probability(queue, rate, world) == pytest.approx(expected, abs=1e-12)


def test_queues_too_large_for_the_planner_are_decided_without_it() -> None:
    assert _mission(_world(queue_capacity=2_000)).planner is not None
    mission = _mission(_world(queue_capacity=100_000), "guided")
    assert mission.planner is None
    mission.observe(_report(0, 0, [90_000.0, 5.0], [50.0, 50.0]), 0)
    state = RolloutState.of(mission.belief, mission.scenario, 0, 0, seed=0, reserved=())
    assert np.isfinite(evaluate(state, [Action(0, 7), Action(1, 0)]).lost).all()


@pytest.mark.parametrize("failed", [True, False])
@pytest.mark.parametrize("other_first", [True, False])
def test_an_outcome_settles_a_visit_whoever_reports_first(failed: bool, other_first: bool) -> None:
    mission = _mission(_world(uavs=2))
    for uav in (0, 1):
        mission.observe(_report(uav, 0, [50.0, 20.0], [50.0, 50.0]), 0)
    for uav, decision in ((0, "a" * 32), (1, "b" * 32)):
        mission.commit(Pending(decision, uav, 0, uav, 0, {"queue": "50", "age": "0"}, None))
    if not failed:
        # The belief expects that this transmission fails.
        mission.belief.channel.failures._odds[0], mission.belief.channel.failures.none = 4.0, False
    queues = [55.0, 5.0] if failed else [5.0, 5.0]
    if other_first:
        mission.observe(_report(1, 1, queues, [50.0, 50.0]), 1)
    mission.apply(Outcome(decision_id="a" * 32, cost=0.0, failed=failed))
    for uav in (0, 1)[: 1 if other_first else 2]:
        mission.observe(_report(uav, 1, queues, [50.0, 50.0]), 1)
    last = -1 if failed else 0
    assert (int(mission.records.visits[0]), int(mission.belief.visited[0])) == (last, last)


def test_a_uav_a_step_behind_its_fleet_has_a_plan() -> None:
    world = _world(uavs=2)
    belief = FleetBelief(world)
    planner = RecedingHorizon(world, belief)
    belief.locate(0, 5, (300.0, 0.0), 300.0)
    belief.locate(1, 4, (400.0, 0.0), 400.0)
    belief.places[:] = [[300.0, 0.0], [500.0, 0.0]]
    planner.begin(5)
    draft = planner.draft([1])
    assert draft is not None
    planner.adopt(draft, draft.search())
    assert planner.action(1) is not None


def test_of_many_uavs_at_one_place_those_are_planned_that_need_a_decision() -> None:
    world = _world(sensors=20, uavs=16)
    belief = FleetBelief(world)
    belief.places[:] = np.random.default_rng(0).uniform(0, 1000, (20, 2))
    for uav in range(16):
        belief.locate(uav, 0, (0.0, 0.0), 0.0)
    planner = RecedingHorizon(world, belief)
    planner.begin(0)
    for needed in ([14], [12, 13, 14, 15], [3]):
        draft = planner.draft(needed)
        assert draft is not None and set(needed) <= set(draft.free)


def test_a_rate_without_width_stays() -> None:
    world = _world(arrival_rate_min=0.002, arrival_rate_max=0.002)
    belief = FleetBelief(world)
    assert belief.arrivals.rate == pytest.approx(0.002)
    belief.arrivals.take(np.array([0]), np.array([1.0]), np.array([1]), np.array([1]))
    assert belief.arrivals.rate[0] < 0.004


def test_a_prompt_with_letters_leaves_no_sensor_out_unsaid() -> None:
    with pytest.raises(Refused, match="at most 20 sensors, not all 30: leave it on"):
        _mission(_world(sensors=30), "guided", attention="off")
    assert _mission(_world(sensors=20), "guided", attention="off").prompt_fits
    assert _mission(_world(sensors=30), "guided", top_k=20).prompt_fits


@pytest.mark.parametrize("form", ["csv", "compact"])
def test_a_prompt_offers_no_velocity_that_the_operator_forbids(form: Literal["csv", "compact"]) -> None:
    mission = _mission(_world(sensors=3), "guided", prompt=PromptStyle(format=form))
    mission.answer_guidance(GuidanceAnswer(guidance=Guidance(max_velocity=3)))
    report = _report(0, 0, [50.0] * 3, [50.0] * 3)
    mission.observe(report, 0)
    candidates = candidates_of(AttendedState.of(mission, report, 0), template_of(mission))
    assert {action.velocity for action in candidates.actions} <= {0, 1, 2, 3}
    assert "14" not in candidates.rows and (form == "csv" or all(row[-2] <= "2" for row in candidates.rows.split("A")))


def test_an_experience_of_a_sensor_never_heard_has_no_numbers() -> None:
    mission = _mission(_world(), "llm", prompt=PromptStyle(format="csv"))
    report = _report(0, 0, [50.0, 1.0], [49.0, 1.0])
    unheard = report.sensors.model_copy(
        update={
            name: [getattr(report.sensors, name)[0], None] for name in ("queue", "battery", "channel_gain", "last_seen")
        }
    )
    report = report.model_copy(update={"sensors": unheard})
    mission.observe(report, 0)
    state = AttendedState.of(mission, report, 0)
    seen = [state.pending(f"{sensor:032x}", Action(sensor, 7)).seen for sensor in (0, 1)]
    assert (seen[0]["queue"], seen[1]["queue"], seen[1]["battery"]) == ("50", "?", "?")


def test_a_delayed_report_does_not_undo_a_later_decision() -> None:
    mission = _mission(_world(uavs=2))

    def decided(step: int, decision_id: str, sensor: int) -> None:
        attempt = mission.observe(_report(0, step, [50.0 - step, 20.0], [50.0] * 2), step)
        mission.commit(Pending(decision_id * 32, 0, step, sensor, 3, {"queue": "1", "age": "0"}, None), attempt)

    decided(5, "a", 0)
    decided(4, "b", 1)
    assert mission.belief.decided(5) == {0: (0, 3)}
    mission.observe(_report(1, 6, [0.0, 25.0], [50.0] * 2), 6)
    assert mission.belief.uavs[0].step == 6 and mission.belief.visited.tolist() == [5, -1]


def test_a_step_that_is_asked_again_after_the_fleet_went_on_is_decided_anew() -> None:
    mission = _mission(_world(uavs=2))
    for uav, step, sensor, decision_id in ((0, 5, 0, "a"), (1, 6, 1, "b"), (0, 5, 1, "c")):
        attempt = mission.observe(_report(uav, step, [50.0, 20.0], [50.0] * 2), step)
        mission.commit(Pending(decision_id * 32, uav, step, sensor, 3, {"queue": "1", "age": "0"}, None), attempt)
    assert mission.belief.decided(5) == {0: (1, 3)}
