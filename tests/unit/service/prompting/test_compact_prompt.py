"""The compact prompt: a digit for each number, and the missions that have it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import candidates_of, template_of
from service.errors import Refused
from service.mission.mission import Mission
from service.prompting.candidates import Viewpoint
from service.prompting.compact_prompt import SIGNS, CompactTemplate, Outlook, digits, in_words, sign
from service.prompting.experiences import Experience
from shared.wire.schemas import MissionSpec
from shared.world.scenario import SCENARIOS, Scenario
from shared.world.step_rule import Action
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request
from tests.support.missions import PAPER, attended

ADAPTED = Settings(mode="llm", llm_url="http://127.0.0.1:9/v1", llm_adapter="served")
MESSAGE = re.compile(r"(\d{6})U((?:\d[a-jk]\d{7}[A-T])+)".replace("a-jk", SIGNS))


def flown(scenario: Scenario, steps: int, **spec: object) -> tuple[Mission, AttendedState]:
    """A mission after some steps of UAVs that fly at 10 m/s and collect nothing, and the last UAV's state."""
    mission = Mission("test", MissionSpec.model_validate({"scenario": scenario, **spec}), ADAPTED)
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=3)
    for _ in range(steps):
        for agent, one in world.live.items():
            report = decide_request(one, observations[agent], "test")
            mission.observe(report, report.step)
            state = attended(mission, report, report.step)
        observations, *_ = world.step({agent: np.array((0, 10)) for agent in world.live})
    return mission, state


def test_numbers_become_digits() -> None:
    assert digits([-3.0, 0.4, 0.6, 8.7, 9.4, 60.0]).tolist() == [0, 0, 1, 9, 9, 9]


@pytest.mark.parametrize("name", ["paper", "shadowed", "dense", "stress"])
def test_the_message_is_one_line_of_letters_and_digits(name: str) -> None:
    mission, state = flown(SCENARIOS[name], 4)
    found = MESSAGE.fullmatch(candidates_of(state, template_of(mission)).rows)
    assert found is not None
    rows = re.findall(r"\d(\D)\d{7}([A-T])", found[2])
    assert rows == [(sign(int(state.state.ids[row])), f) for row, f in zip(state.shown(), "AEIMQ", strict=False)]
    # One token a character, and 8 around the message: at most 70 are read anew.
    assert len(found[0]) + 8 <= 70
    assert "U" not in mission.template.static.replace("Collect", "")


def test_each_of_a_hundred_sensors_has_its_own_sign() -> None:
    assert len({sign(sensor) for sensor in range(100)}) == 100
    assert not any(one.isdigit() or one.isupper() for one in SIGNS)
    assert sign(len(SIGNS) + 3) == sign(3)


@pytest.mark.parametrize(
    ("seen", "cost", "failed", "line"),
    [
        ({"queue": "60", "movable": "37"}, 1.4, True, "7d9X"),
        ({"queue": "60", "movable": "0"}, 1.0, True, "0d9X"),
        ({"queue": "60", "movable": "60"}, 0.0, False, "9d0Y"),
        ({"queue": "15"}, 0.51, False, "4d5Y"),
        ({"queue": "?", "movable": "?"}, 0.0, False, "0d0Y"),
    ],
)
def test_an_experience_has_what_was_expected_and_what_it_cost(
    seen: dict[str, str], cost: float, failed: bool, line: str
) -> None:
    assert CompactTemplate(PAPER, rows=5).experience(seen, Action(3, 14), cost, failed) == line


def test_experiences_come_first_and_a_mission_has_none_unless_it_asks() -> None:
    for count, before in ((0, ""), (2, "7d9X9a0Y")):
        mission, state = flown(PAPER, 2, prompt={"experiences": count, "format": "compact"}, mode="guided")
        for line in ("7d9X", "9a0Y"):
            mission.experiences.remember(Experience(line, 3, failed=True))
        template = template_of(mission)
        candidates = candidates_of(state, template)
        prompt = template.choice_prompt(candidates, state.state, mission.experiences.block)
        assert prompt.user == before + candidates.rows
        assert mission.spec.prompt.selection == "failures"


def test_a_row_shows_the_queue_and_what_can_be_collected() -> None:
    mission, state = flown(PAPER, 3)
    text = candidates_of(state, template_of(mission)).rows
    found = MESSAGE.fullmatch(text)
    assert found is not None
    rows = re.findall(r"(\d)\D(\d{7})[A-T]", found[2])
    for parts, shown in zip(rows, state.shown(), strict=True):
        row = "".join(parts)
        queue, packets = state.state.queue[shown], state.reach.best_packets[shown]
        assert int(row[0]) == round(9 * (queue / PAPER.queue_capacity) ** 0.5)
        assert int(row[2]) == round(9 * (packets / PAPER.queue_capacity) ** 0.5)


def test_the_digits_are_told_in_words() -> None:
    sensors = SCENARIOS["pipeline"].sensors
    text = f"340000U8{sign(2)}3692140E9{sign(sensors - 1)}9109909A"
    assert in_words(text, range(sensors), PAPER) == [
        "3 steps are left. The mean queue is 44% full.",
        "E: sensor 2 has about 47 of 60 packets and overflows in 3 steps. The UAV collects up to about 27 at 6 to 0 "
        "m/s; the link holds with 100%. The UAV reaches it in 2 of the next 9 steps, others in 1.",
        f"A: sensor {sensors - 1} has about 60 of 60 packets and overflows in 9 or more steps. The UAV collects up to "
        "about 1 at 0 to 14 m/s; the link holds with 0%. The UAV reaches it in 9 of the next 9 steps, others in 9 or "
        "more.",
    ]


@pytest.mark.parametrize("name", ["paper", "stress", "pipeline"])
def test_the_words_are_those_of_the_digits(name: str) -> None:
    mission, state = flown(SCENARIOS[name], 3)
    text, scenario = candidates_of(state, template_of(mission)).rows, mission.scenario
    words = in_words(text, state.state.ids.tolist(), scenario)
    assert len(words) == 1 + len(text[7:]) // 10
    for line, row in zip(words[1:], re.findall(".{10}", text[7:]), strict=True):
        found = re.match(r"(.): sensor (\d+) has about (\d+) of", line)
        assert found is not None and found[1] == row[-1] and sign(int(found[2])) == row[1]
        assert digits(9 * np.sqrt(int(found[3]) / scenario.queue_capacity)) == int(row[0])


def test_an_outlook_counts_the_steps_in_reach() -> None:
    mission, state = flown(PAPER, 3)
    outlook = Outlook.of(Viewpoint(mission.belief, state.uav_id, state.step), PAPER)
    assert outlook.ahead.shape == (9, PAPER.sensors)
    assert np.array_equal(outlook.own, outlook.ahead.sum(axis=0))
    own = belief_steps(mission, state.uav_id)
    assert np.array_equal(outlook.own, own)
    others = [belief_steps(mission, one) for one in range(PAPER.uavs) if one != state.uav_id]
    assert np.array_equal(outlook.others, np.sum(others, axis=0))


def belief_steps(mission: Mission, one: int) -> np.ndarray:
    metres = 0.6 * PAPER.max_velocity * PAPER.step_s * np.arange(1.0, 10.0)
    return np.asarray((mission.belief.links(one, metres).likely > 0).sum(axis=0))


def test_reported_belief_has_the_formulas_links() -> None:
    _, learned = flown(SCENARIOS["shadowed"], 6, mode="llm")
    _, formula = flown(SCENARIOS["shadowed"], 6, mode="llm", belief="reported")
    assert learned.state.channel is not None
    assert formula.state.channel is None


@pytest.mark.parametrize("mode", ["llm", "guided"])
def test_a_mission_has_it_where_the_llm_has_an_adapter(mode: str) -> None:
    mission = Mission("test", MissionSpec.model_validate({"mode": mode}), ADAPTED)
    assert isinstance(mission.template, CompactTemplate)
    assert (mission.spec.prompt.format, mission.spec.prompt.experiences) == ("compact", 0)
    assert (mission.features, mission.belief_source) == ("reach", "fleet")
    plain = Mission("test", MissionSpec.model_validate({"mode": mode}), Settings(llm_adapter="off"))
    assert plain.spec.prompt.format == "csv"
    chosen = Mission("test", MissionSpec.model_validate({"mode": mode, "prompt": {"format": "csv"}}), ADAPTED)
    assert not isinstance(chosen.template, CompactTemplate)


def test_a_mission_without_an_llm_has_the_long_prompt() -> None:
    assert Mission("test", MissionSpec(mode="value"), ADAPTED).spec.prompt.format == "csv"


def test_an_llm_without_the_adapter_is_not_asked_in_it() -> None:
    spec = MissionSpec.model_validate({"mode": "llm", "prompt": {"format": "compact"}})
    with pytest.raises(Refused, match="AICVDS_LLM_ADAPTER"):
        Mission("test", spec, Settings(llm_adapter="off"))
    made = Mission("test", spec, ADAPTED)
    again = Mission("test", spec, Settings(llm_adapter="off"), made.spec)
    assert not again.prompt_fits


def test_it_is_about_one_uav() -> None:
    fit = Mission("test", MissionSpec(mode="guided"), ADAPTED).prompt_fit
    assert fit.fits(1)
    assert not fit.fits(3)


def test_a_note_leaves_the_static_block_as_the_adapter_knows_it() -> None:
    noted = Mission("test", MissionSpec(mode="llm", note="visit sensor 2 every third step"), ADAPTED)
    assert noted.template.static == Mission("test", MissionSpec(mode="llm"), ADAPTED).template.static


def test_the_packages_adapter_belongs_to_the_packages_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = tmp_path / "adapter.gguf"
    monkeypatch.setattr("service.config.settings.SHIPPED_ADAPTER", shipped)
    assert Settings().embedded_adapter is None
    shipped.touch()
    assert Settings().embedded_adapter == shipped
    assert Settings(llm_adapter="off").embedded_adapter is None
    assert Settings(llm_gguf=tmp_path / "other.gguf").embedded_adapter is None
    assert Settings(llm_url="http://127.0.0.1:9/v1").embedded_adapter is None
    assert not Settings(llm_url="http://127.0.0.1:9/v1").adapted
    assert Settings(llm_adapter=str(tmp_path / "mine.gguf")).embedded_adapter == tmp_path / "mine.gguf"
