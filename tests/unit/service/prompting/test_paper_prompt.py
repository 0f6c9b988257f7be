import hashlib
import itertools
import re
from typing import Any, Literal

import pytest

from service.api.mission_answers import status_of
from service.errors import Refused
from service.prompting.paper_prompt import Template
from service.prompting.prompt import Prompt
from shared.wire.schemas import MissionSpec, Outcome, PromptStyle
from shared.world.scenario import SCENARIOS
from shared.world.step_rule import Action
from tests.support.missions import PAPER, attended, mission, uav, written_rows


def flown(steps: int = 3, spec: MissionSpec | None = None, **settings: Any) -> list[Prompt]:
    """The prompts of a mission's first steps, each decided for sensor 1 at 7 m/s and paid for."""
    m = mission(spec, **settings)
    prompts = []
    for step in range(steps):
        view = attended(m, uav(step=step, position=(500.0 + step, 500.0)), step)
        prompts.append(m.template.prompt(view.state, view.shown(), m.experiences.block))
        m.commit(view.pending(f"{step:032x}", Action(1, 7)))
        m.apply(Outcome(decision_id=f"{step:032x}", cost=0.125))
    return prompts


@pytest.mark.parametrize("order", ["score", "shuffled"])
def test_the_static_block_is_the_same_bytes_at_every_step(order: Literal["score", "shuffled"]) -> None:
    prompts = flown(spec=MissionSpec(prompt=PromptStyle(order=order)))
    assert len({p.static for p in prompts}) == 1
    assert len({p.state for p in prompts}) > 1
    for earlier, later in itertools.pairwise(prompts):
        assert later.experiences.startswith(earlier.experiences)


def test_the_static_block_tells_the_scenarios_numbers() -> None:
    assert Template(PAPER).static != Template(SCENARIOS["paper"].model_copy(update={"queue_capacity": 50})).static


def test_by_default_the_static_block_changes_on_purpose_only() -> None:
    static = mission().template.static
    assert static == Template(PAPER).static
    assert hashlib.sha256(static.encode()).hexdigest().startswith("1df9986b1568d9a1")


@pytest.mark.parametrize(
    ("max_velocity", "rule"),
    [
        (14, "8 to 14 beyond 50 m, 1 to 7 within 50 m, 0 while hovering at it."),
        (8, "8 beyond 50 m, 1 to 7 within 50 m, 0 while hovering at it."),
        (5, "5 beyond 50 m, 1 to 5 within 50 m, 0 while hovering at it."),
        (1, "1 beyond 50 m, 1 within 50 m, 0 while hovering at it."),
    ],
)
@pytest.mark.parametrize("features", ["paper", "reach"])
def test_the_velocity_rule_is_the_papers_up_to_the_worlds_limit(
    max_velocity: int, rule: str, features: Literal["paper", "reach"]
) -> None:
    scenario = PAPER.model_copy(update={"max_velocity": max_velocity})
    static = Template(scenario, features).static
    strategy = static.split("Velocity strategy, in whole m/s:\n")[1].split("\n\n")[0].splitlines()
    assert strategy[0] == f"- By the chosen sensor's distance: {rule}"
    assert "slow" not in static.lower() and "fast" not in static.lower()


def test_rows_are_sorted_by_score_and_say_what_is_known() -> None:
    m = mission(top_k=2)
    m.records.visits[0] = 4
    view = attended(m, uav(step=6, queue=[30.0, None, 60.0, 15.0]), 6)
    prompt = m.template.prompt(view.state, view.shown(), [])
    lines = written_rows(view.state)
    assert [line.rstrip() for line in lines] == [
        "0,30,50,-90,0,2,25,0",
        "1,?,?,?,100,6,?,?",
        "2,60,50,-90,200,6,100,100",
        "3,15,50,-90,300,6,13,0",
    ]
    assert prompt.uncompressed.head == "UAV at 500,500\n"
    waypoint, *rows = prompt.state.splitlines(keepends=True)
    assert waypoint == prompt.uncompressed.head
    assert rows == [lines[sensor] for sensor in view.kept_ids]


def test_experiences_stand_between_static_and_state() -> None:
    last = flown()[-1]
    line = "20,50,-90,100,0,17,0 > 1 7: 0.12\n"
    assert last.experiences.startswith(line)
    assert last.user == last.experiences + last.state


def test_the_static_block_speaks_of_what_the_mission_shows() -> None:
    static = mission().template.static
    assert "Past experiences are the chosen" in static
    assert "the most promising first" in static
    shuffled = mission(MissionSpec(prompt=PromptStyle(order="shuffled"))).template.static
    assert "the most promising first" not in shuffled
    assert "in no particular order" in shuffled


def test_shuffled_rows_are_the_same_rows_in_an_order_of_seed_step_and_uav() -> None:
    def order(seed: int, step: int, uav_id: int) -> list[int]:
        m = mission(MissionSpec(prompt=PromptStyle(order="shuffled"), seed=seed))
        view = attended(m, uav(step=step, uav_id=uav_id), step)
        prompt = m.template.prompt(view.state, view.shown(), [])
        shown = [int(line.split(",")[0]) for line in prompt.state.splitlines()[1:]]
        assert sorted(shown) == sorted(view.kept_ids)
        return shown

    cases = [(seed, step, uav_id) for seed in range(2) for step in range(3) for uav_id in range(2)]
    orders = [order(*case) for case in cases]
    assert orders == [order(*case) for case in cases]
    assert len({tuple(o) for o in orders}) > 6


def test_shuffling_changes_the_prompt_and_nothing_else() -> None:
    shuffled = mission(MissionSpec(prompt=PromptStyle(order="shuffled")))
    view, plain = attended(shuffled, uav()), attended(mission(), uav())
    assert view.candidates == plain.candidates
    assert view.best_by_value() == plain.best_by_value()


def test_without_attention_every_admissible_sensor_is_shown_in_the_requests_order() -> None:
    m = mission(MissionSpec(attention="off", top_k=2, mode="llm"), llm_adapter="off")
    view = attended(m, uav(queue=[30.0, None, 60.0, 15.0]))
    prompt = m.template.prompt(view.state, view.shown(), [])
    assert [int(line.split(",")[0]) for line in prompt.state.splitlines()[1:]] == view.kept_ids == [0, 2, 3]
    assert "in no particular order" in prompt.static


def test_mode_value_keeps_attention_which_is_all_that_it_has() -> None:
    m = mission(MissionSpec(attention="off", top_k=2))
    assert len(attended(m, uav()).kept_ids) == 2


def test_as_many_as_there_are_sensors_are_offered_best_first_or_shuffled() -> None:
    for order in ("score", "shuffled"):
        m = mission(MissionSpec(top_k=100, prompt=PromptStyle(order=order)))
        view = attended(m, uav())
        scores = [candidate.score for candidate in view.candidates]
        assert len(scores) == 6
        assert scores == sorted(scores, reverse=True)
        assert (view.shown() == view.rows) == (order == "score")


def test_no_experiences_means_no_block_and_no_word_of_it() -> None:
    prompts = flown(4, MissionSpec(prompt=PromptStyle(experiences=0)))
    assert [p.experiences for p in prompts] == [""] * 4
    assert "Past experiences" not in prompts[0].static


@pytest.mark.parametrize(("reported", "kept"), [(None, 30), (6, 6), (100, 100)])
def test_a_mission_says_how_many_experiences_it_keeps(reported: int | None, kept: int) -> None:
    spec = MissionSpec(mode="llm", prompt=PromptStyle(format="csv", experiences=reported))
    prompts = flown(105, spec, llm_context=8192)
    assert max(len(p.experiences.splitlines()) for p in prompts) == kept
    status = status_of(mission(spec, llm_context=8192))
    assert status.prompt.experiences == kept


def test_thirty_experiences_fit_the_embedded_models_context() -> None:
    spec = MissionSpec(mode="llm", prompt=PromptStyle(experiences=30), top_k=10)
    assert status_of(mission(spec)).prompt.experiences == 30


@pytest.mark.parametrize(
    "spec",
    [
        MissionSpec(mode="llm", scenario="dense", prompt=PromptStyle(format="csv", experiences=100), top_k=20),
        MissionSpec(
            mode="llm",
            attention="off",
            scenario=SCENARIOS["dense"].model_copy(update={"sensors": 500}),
            prompt=PromptStyle(format="csv"),
        ),
    ],
)
def test_a_prompt_that_cannot_fit_the_context_is_refused(spec: MissionSpec) -> None:
    with pytest.raises(Refused, match=r"need up to \d+ tokens and AICVDS_LLM_CONTEXT is 4096"):
        mission(spec)
    assert mission(spec, llm_context=131_072).mode == "llm"
    assert mission(spec.model_copy(update={"mode": "value"})).mode == "value"


# The elements of the paper's prompt figure, each with what our template has for it: a pattern, and the block to search.
FIGURE = {
    "goal: packet loss over all sensors": r"Goal: lose as few packets as possible over all sensors",
    "decision 1: one sensor, ID 0-9": r"one ground sensor to collect from \(ID 0 to 9\)",
    "decision 2: a velocity, 0-14": r"the velocity for the next 10 seconds \(0 to 14 m/s\)",
    "procedure 1: analyse queue": r"1\. Look at every sensor .*queue",
    "procedure 1: residual energy": r"1\. Look .*residual energy",
    "procedure 1: location": r"1\. Look .*location",
    "procedure 1: channel quality": r"1\. Look .*channel quality \(path loss\)",
    "procedure 1: time since last visit": r"1\. Look .*time since its last visit",
    "procedure 1: urgency": r"1\. Look .*urgency",
    "procedure 1: overflow": r"1\. Look .*overflow probability",
    "procedure 2: long queue": r"2\. Rank .*long queue",
    "procedure 2: urgency or overflow": r"2\. Rank .*high urgency or overflow probability",
    "procedure 2: long without a visit": r"2\. Rank .*long time without a visit",
    "procedure 2: low energy": r"2\. Rank .*little residual energy",
    "procedure 2: good channel": r"2\. Rank .*good channel \(low path loss\)",
    "procedure 3: review past decisions": r"3\. Compare with past decisions",
    "procedure 4: exactly one of each": r"4\. Choose exactly one sensor and one velocity",
    "rule: queue": r"- Long queues come first.*overflow",
    "rule: channel": r"- A better channel \(a higher gain, less path loss\).*succeed",
    "rule: battery": r"- Collect from a sensor with a low battery before its energy is used up",
    "rule: urgency and overflow": r"- A high UrgencyScore comes first, above all with a high OverflowProb",
    "rule: visits": r"- A large TimeSinceLastVisit comes first.*none is neglected",
    "velocity beyond 50 m": r"8 to 14 beyond 50 m",
    "velocity within 50 m": r"1 to 7 within 50 m",
    "velocity while hovering": r"0 while hovering at it",
    "velocity and travel time": r"higher velocity can shorten the travel time",
    "cost: packet loss": r"- Packet loss: a poor channel \(high path loss\) loses packets",
    "cost: overflow": r"- Queue overflow: a queue holds 60 packets; what arrives beyond that is dropped",
    "task: selected by attention": r"the sensors that attention selected",
    "columns": "\nSensorID,Queue,BatteryLevel,ChannelGain,Distance,TimeSinceLastVisit,UrgencyScore,OverflowProb\n",
    "output: two integers": r"Output: exactly two whole numbers with a space between them, sensor_id velocity",
    "output: nothing else": r"nothing else: no explanation, no reasoning",
}


@pytest.mark.parametrize("element", FIGURE)
def test_every_element_of_the_papers_figure_is_in_the_prompt(element: str) -> None:
    static = mission(MissionSpec(mode="llm"), llm_adapter="off").template.static
    assert re.search(FIGURE[element], static)


def test_past_experiences_and_waypoint_come_with_the_decision() -> None:
    m = mission(MissionSpec(mode="llm"), llm_adapter="off")
    for step in range(31):
        view = attended(m, uav(step=step, position=(500.0 + step, 450.0)), step)
        prompt = m.template.prompt(view.state, view.shown(), m.experiences.block)
        past = prompt.experiences.splitlines()
        assert len(past) == step
        # The previous state in seven numbers, the sensor, the velocity and the cost.
        assert all(re.fullmatch(r"(-?\d+,){6}\d+ > 1 7: 0\.12", line) for line in past)
        waypoint, *rows = prompt.state.splitlines()
        assert waypoint == f"UAV at {500 + step},450"
        assert rows and all(len(row.split(",")) == 8 for row in rows)
        m.commit(view.pending(f"{step:032x}", Action(1, 7)))
        m.apply(Outcome(decision_id=f"{step:032x}", cost=0.125))


def test_the_papers_prompt_is_mode_llms_for_a_served_llm_and_compact_with_the_adapter() -> None:
    served = mission(MissionSpec(mode="llm"), llm_url="http://127.0.0.1:1/v1")
    assert type(served.template) is Template
    assert status_of(served).prompt.experiences == 30
    assert type(mission(MissionSpec(mode="llm")).template) is not Template
