"""The compact prompt shows orders as queues: confirmed ones, and before that what the LLM read of the note."""

from __future__ import annotations

import numpy as np
import pytest

from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import candidates_of, template_of
from service.mission.mission import Mission
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance
from shared.wire.schemas import MissionSpec, Mode
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request
from tests.support.missions import PAPER, attended
from tests.unit.service.prompting.test_compact_prompt import ADAPTED

CAPACITY = PAPER.queue_capacity
ORDERS = Guidance.model_validate(
    {"sensors": [{"sensor_id": 4, "visit_every": 4}, {"sensor_id": 2, "weight": 0}], "max_velocity": 6}
)


class Flown:
    """A mission with a note after some steps in which nothing was collected, seen anew by its last UAV."""

    def __init__(self, mode: Mode, steps: int = 4) -> None:
        self.mission = Mission("test", MissionSpec(mode=mode, note="visit sensor 4, not over 6 m/s"), ADAPTED)
        world = PipelineWorld(PAPER)
        observations, _ = world.reset(seed=3)
        for _ in range(steps):
            for agent, one in world.live.items():
                self.report = decide_request(one, observations[agent], "test")
                self.mission.observe(self.report, self.report.step)
            observations, *_ = world.step({agent: np.array((0, 10)) for agent in world.live})

    def state(self) -> AttendedState:
        return attended(self.mission, self.report, self.report.step)

    def read(self, orders: object = ORDERS) -> None:
        self.mission.propose_guidance(Guidance.model_validate(orders), "an LLM")


def prompted(state: AttendedState) -> tuple[np.ndarray, np.ndarray]:
    """The queues that the prompt shows, and the true ones, by sensor ID."""
    order = np.argsort(state.state.ids)
    return state.prompt_view.state.queue[order], state.state.queue[order]


def test_a_visits_deadline_is_a_queue_that_overflows_then_and_a_weight_scales_a_queue() -> None:
    flown = Flown("llm", steps=3)
    flown.read()
    state = flown.state()
    shown, true = prompted(state)
    # A sensor never visited counts as visited just before step 0, three steps before this one.
    assert state.step == 2
    assert shown[4] == pytest.approx(max(0.75 * CAPACITY, true[4]))
    assert shown[2] == 0 < true[2]
    others = [0, 1, 3, *range(5, PAPER.sensors)]
    assert np.array_equal(shown[others], true[others])
    rate = state.prompt_view.state.rate[state.state.ids == 4][0]
    assert (CAPACITY - shown[4]) / rate <= 1.0


def test_a_visit_that_is_due_is_in_the_prompt_even_where_attention_has_kept_others() -> None:
    flown = Flown("llm", steps=8)
    assert 0 not in flown.state().kept_ids
    flown.read({"sensors": [{"sensor_id": 0, "visit_every": 4}]})
    state = flown.state()
    assert state.prompt_view.reach is not None
    reached = state.prompt_view.reach.best_packets[state.state.ids == 0][0]
    assert reached > 0.9 * CAPACITY
    assert 0 in state.kept_ids


def test_in_mode_llm_the_candidates_obey_the_reading_and_the_fleets_own_rules_wait_for_the_operator() -> None:
    flown = Flown("llm")
    assert max(velocity for _, velocity in candidates_of(flown.state(), template_of(flown.mission)).actions) > 6
    flown.read()
    state = flown.state()
    assert max(velocity for _, velocity in candidates_of(state, template_of(flown.mission)).actions) <= 6
    assert state.guidance is None
    assert flown.mission.guidance.confirmed.allows(14)


def test_in_mode_guided_a_reading_is_in_the_rows_alone() -> None:
    flown = Flown("guided")
    before = flown.state()
    flown.read()
    state = flown.state()
    assert prompted(state)[0][2] == 0
    assert state.kept_ids == before.kept_ids
    template = template_of(flown.mission)
    assert candidates_of(state, template).actions == candidates_of(before, template).actions
    assert candidates_of(state, template).rows != candidates_of(before, template).rows


def test_orders_in_force_stay_in_the_prompt_beside_a_second_note_that_was_only_read() -> None:
    flown = Flown("llm")
    flown.mission.answer_guidance(GuidanceAnswer(guidance=ORDERS))
    flown.mission.answer_guidance(GuidanceAnswer(note="visit sensor 7 now and then"))
    flown.read({"sensors": [{"sensor_id": 7, "visit_every": 4}], "min_velocity": 3})
    state = flown.state()
    shown, true = prompted(state)
    assert shown[2] == 0 < true[2]
    assert min(shown[4], shown[7]) >= 0.75 * CAPACITY
    velocities = {velocity for _, velocity in candidates_of(state, template_of(flown.mission)).actions}
    assert velocities <= {3, 4, 5, 6}


@pytest.mark.parametrize("second", [{}, {"min_velocity": 9}])
def test_a_reading_that_orders_nothing_or_the_contrary_takes_no_order_in_force_away(second: dict[str, int]) -> None:
    flown = Flown("llm")
    flown.mission.answer_guidance(GuidanceAnswer(guidance=ORDERS))
    flown.mission.answer_guidance(GuidanceAnswer(note="hm"))
    flown.read(second)
    state = flown.state()
    assert prompted(state)[0][2] == 0
    assert max(velocity for _, velocity in candidates_of(state, template_of(flown.mission)).actions) <= 6


def test_a_visit_that_only_forbidden_velocities_bring_in_reach_takes_no_row() -> None:
    """Attention adds what orders add at velocities that the operator allows."""
    for steps in range(2, 8):
        for sensor in range(PAPER.sensors):
            flown = Flown("llm", steps=steps)
            orders = {"sensors": [{"sensor_id": sensor, "visit_every": 2}], "max_velocity": 3}
            flown.mission.answer_guidance(GuidanceAnswer(guidance=Guidance.model_validate(orders)))
            state = flown.state()
            view, row = state.prompt_view, np.flatnonzero(state.state.ids == sensor)
            if not len(row) or view.reach is None or view.added is None or state.reach.likely[:4, row[0]].any():
                continue
            if state.reach.likely[4:, row[0]].any():
                assert view.added[row[0]] <= view.reach.packets[:4, row[0]].max()
                return
    raise AssertionError("no such sensor")


def test_a_rejected_reading_leaves_the_prompt_and_a_confirmed_one_stays() -> None:
    flown = Flown("llm")
    flown.read()
    flown.mission.answer_guidance(GuidanceAnswer(answer="confirm"))
    assert prompted(flown.state())[0][2] == 0
    again = Flown("llm")
    again.read()
    again.mission.answer_guidance(GuidanceAnswer(answer="reject"))
    assert np.array_equal(*prompted(again.state()))
