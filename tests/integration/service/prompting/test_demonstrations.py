import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.commands.demonstrate import main
from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, RolloutStep, read_rollouts, write_rollouts
from lab.training.demonstration_teachers import TEACHERS, farthest_first, point, solutions
from service.deciding.advisers import look_ahead
from service.errors import Refused
from service.prompting.demonstrations import packaged
from shared.features.augmented_state import State
from shared.wire.schemas import MissionSpec, Outcome, PromptStyle
from shared.world.actions import Action
from shared.world.scenario import SCENARIOS, Scenario
from tests.support.missions import PAPER, attended, mission, uav

SHORT = PAPER.model_copy(update={"steps": 8})
HEADER = Header(scenario=PAPER, missions=1, behaviour="test")


def static(spec: MissionSpec, **settings: Any) -> str:
    return mission(spec, **settings).template.static


def shown(demonstrations: int, **style: Any) -> MissionSpec:
    return MissionSpec(prompt=PromptStyle(demonstrations=demonstrations, **style))


def test_none_by_default_and_no_word_of_them() -> None:
    assert "Worked examples" not in static(MissionSpec())
    assert static(shown(0)) == static(MissionSpec())


@pytest.mark.parametrize("count", [1, 6, 20])
def test_a_prompt_shows_as_many_as_it_is_told(count: int) -> None:
    text = static(shown(count))
    assert text.count("Answer: ") == count
    assert text.split("\n\n")[-1].startswith("Output: exactly two whole numbers")
    # More are the same and then some: the most telling come first.
    assert static(shown(20)).startswith(text[: text.index("\n\nOutput: ")])


def test_each_is_what_a_decision_looks_like_and_offers_its_answer() -> None:
    text = static(MissionSpec(top_k=3, prompt=PromptStyle(demonstrations=20)))
    _, *examples = text.split("Worked examples, each solved by a scheduler that looks ahead:")[1].split("\n\n")[:-1]
    assert len(examples) == 20
    places = set()
    for example in examples:
        *rows, answer = example.splitlines()
        offered = [int(row.split(",")[0]) for row in rows]
        assert all(len(row.split(",")) == 8 for row in rows)
        assert 2 <= len(offered) <= 3
        sensor, velocity = map(int, answer.removeprefix("Answer: ").split())
        assert 0 <= velocity <= 14
        places.add(offered.index(sensor))
    assert len(places) > 1, "an LLM must not learn that the first row is always the answer"


def test_preset_reach_shows_them_with_its_columns() -> None:
    ahead = static(MissionSpec(features="reach", prompt=PromptStyle(demonstrations=2))).split("looks ahead:")[1]
    assert len(ahead.split()[0].split(",")) == 10


def test_shuffled_rows_are_shuffled_in_the_examples_too_by_the_missions_seed() -> None:
    spec = shown(6, order="shuffled")
    assert static(spec) == static(spec) != static(shown(6))
    assert static(spec) != static(spec.model_copy(update={"seed": 1}))


def test_the_static_block_stays_as_it_is_while_the_modules_learn() -> None:
    m = mission(shown(6))
    before = m.template.static
    for step in range(4):
        view = attended(m, uav(step=step), step)
        m.commit(view.pending(f"{step:032x}", Action(1, 7)))
        sample = m.apply(Outcome(decision_id=f"{step:032x}", cost=1.0))
        assert sample is not None
        m.learner.update(sample, 1.0)
        assert m.template.prompt(view.state, view.shown(), m.experiences.block).static == before


def test_a_slower_fleet_sees_no_velocity_past_its_limit() -> None:
    slow = MissionSpec(scenario=PAPER.model_copy(update={"max_velocity": 8}), prompt=PromptStyle(demonstrations=20))
    answers = [line for line in static(slow).splitlines() if line.startswith("Answer: ")]
    assert answers
    assert max(int(answer.split()[2]) for answer in answers) <= 8


def test_twenty_fit_the_embedded_models_context_and_what_does_not_is_refused() -> None:
    assert mission(shown(20, experiences=8).model_copy(update={"mode": "llm"})).template.static
    with pytest.raises(Refused, match=r"20 demonstrations .* lower prompt.experiences, prompt.demonstrations or top_k"):
        mission(shown(20, experiences=100).model_copy(update={"mode": "llm"}))


def test_the_shipped_ones_are_the_planners_and_each_collects_something_that_was_free() -> None:
    pool = packaged()
    assert pool.teacher == "planner"
    short_sighted = 0
    for d in pool.demonstrations:
        state = d.state(pool.scenario, "reach")
        assert state.reach is not None
        row = state.ids.tolist().index(d.sensor_id)
        assert state.admissible[row]
        assert state.reach.packets[d.velocity, row] >= 1
        short_sighted += look_ahead(state, state.reach_ahead(d.uav.uav_id, pool.scenario), d.reserved) == (
            d.sensor_id,
            d.velocity,
        )
    assert short_sighted < 0.7 * len(pool.demonstrations), "the planner sees further than one step"


def test_a_demonstration_shows_the_reference_that_was_recorded() -> None:
    steps = list(explore(SHORT, 0, "planner"))
    told = {(s.request.uav_id, s.request.step): s.reference for s in steps if s.reference}
    found = list(solutions(HEADER, steps, TEACHERS["planner"]))
    assert len(found) > 5
    for d, _ in found:
        reference = told[d.uav.uav_id, d.step]
        assert (reference.sensor_id, reference.velocity) == (d.sensor_id, d.velocity)
    assert list(solutions(HEADER, steps, TEACHERS["clairvoyant"])) == []


def test_any_teacher_may_solve_them() -> None:
    asked: list[tuple[int, int]] = []

    def fullest(step: RolloutStep, state: State, scenario: Scenario, reserved: object) -> Action:
        row = int(np.argmax(np.where(state.admissible, state.queue, -1)))
        asked.append((step.request.uav_id, scenario.sensors))
        return Action(int(state.ids[row]), 3)

    found = list(solutions(HEADER, explore(PAPER, 0), fullest))
    assert 0 < len(found) <= len(asked) <= 90
    assert {d.velocity for d, _ in found} == {3}
    assert all(point.min() >= 0 and point.max() <= 1 for _, point in found)
    assert len({point.shape for _, point in found}) == 1


def test_the_farthest_comes_next() -> None:
    points = np.array([[0.0], [0.45], [1.0], [0.5], [0.9]])
    assert farthest_first(points, 5) == [3, 0, 2, 4, 1]
    assert farthest_first(points, 2) == [3, 0]


def test_what_is_alike_depends_on_the_answer() -> None:
    view = attended(mission(MissionSpec(features="reach")), uav())
    one, other = point(view.state, 1, 7, PAPER), point(view.state, 3, 7, PAPER)
    assert not np.allclose(one, other)
    assert np.allclose(point(view.state, 1, 14, PAPER)[:-1], one[:-1])


def test_the_command_writes_what_a_mission_can_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded, out = tmp_path / "r.jsonl.gz", tmp_path / "c" / "d.json"
    write_rollouts(recorded, HEADER, explore(SCENARIOS["paper"], 1))
    look_ahead = ("--teacher", "look_ahead")
    assert main([str(recorded), "--out", str(out), "--count", "5", *look_ahead]) == 0
    assert "5 of" in capsys.readouterr().out
    assert len(json.loads(out.read_text())["demonstrations"]) == 5
    for options, said in (
        (["--count", "1000", *look_ahead], "--count asks for 1000"),
        (["--count", "1"], "has no decision of planner: record with python -m lab explore --teacher both"),
        (["--count", "0"], "--count 0"),
        (["--teacher", "socrates"], "choose one of planner, clairvoyant, look_ahead"),
    ):
        assert main([str(recorded), "--out", str(out), *options]) == 2
        assert said in capsys.readouterr().err
    assert main([str(tmp_path / "none.gz"), "--out", str(out)]) == 2
    assert "none.gz" in capsys.readouterr().err
    assert read_rollouts(recorded)[0] == HEADER
