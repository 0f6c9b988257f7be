from service.prompt import build_prompt, experience_text, static_block
from shared.scenario import SCENARIOS
from tests.service.making import PAPER, attended, mission, uav


def test_the_static_block_is_the_same_bytes_at_every_step() -> None:
    m = mission()
    prompts = []
    for step in range(3):
        view = attended(m, uav(step=step, position=(500.0 + step, 500.0)), step)
        prompts.append(build_prompt(PAPER, view.state, view.rows, m.experiences))
    assert len({p.static for p in prompts}) == 1
    assert len({p.state for p in prompts}) > 1
    assert static_block(PAPER) != static_block(SCENARIOS["paper"].model_copy(update={"queue_capacity": 50}))


def test_rows_are_sorted_by_score_and_say_what_is_known() -> None:
    m = mission(top_k=2)
    m.visits[0] = 4
    view = attended(m, uav(step=6, queue=[30.0, None, 60.0, 15.0]), 6)
    prompt = build_prompt(PAPER, view.state, view.rows, [])
    assert [int(line.split(",")[0]) for line in prompt.state.splitlines()] == view.offered
    assert prompt.state_uncompressed.splitlines() == [
        "0,30,50,-90,2,0",
        "1,?,?,?,6,100",
        "2,60,50,-90,6,200",
        "3,15,50,-90,6,300",
    ]
    assert set(prompt.state.splitlines()) < {"0,30,-90,2,0", "2,60,-90,6,200", "3,15,-90,6,300"}


def test_experiences_stand_between_static_and_state() -> None:
    view = attended(mission(), uav())
    line = experience_text("0,50,-90,2,40", 0, 7, 0.125)
    prompt = build_prompt(PAPER, view.state, view.rows, [line, line])
    assert line == "50,-90,2,40 > 0 7: 0.1\n"
    assert prompt.user == line + line + prompt.state
