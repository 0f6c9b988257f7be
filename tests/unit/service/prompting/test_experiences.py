import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.api.mission_answers import status_of
from service.config.settings import Settings
from service.prompting.experiences import Experience, Experiences
from shared.wire.schemas import MissionSpec, Outcome, PromptStyle, Selection
from shared.world.step_rule import Action
from tests.support.missions import attended, mission, uav

SELECTIONS: tuple[Selection, ...] = ("recent", "failures")


def past(line: str) -> Experience:
    return Experience(f"{line}\n", 0, False)


def remembering(selection: Selection, limit: int, *experiences: Experience) -> Experiences:
    memory = Experiences(limit, selection)
    for experience in experiences:
        memory.remember(experience)
    return memory


def words(lines: list[str]) -> str:
    return "".join(lines).replace("\n", "")


# Alike lines, sensors and failures are all drawn, and often.
PASTS = st.builds(Experience, st.sampled_from(["a\n", "b\n", "c\n"]), st.integers(0, 3), st.booleans())


@given(st.sampled_from(SELECTIONS), st.integers(0, 9), st.lists(PASTS, max_size=60))
def test_between_compactions_the_block_only_grows(selection: Selection, limit: int, pasts: list[Experience]) -> None:
    memory = Experiences(limit, selection)
    outcomes_since = 0
    for experience in pasts:
        before, compactions = "".join(memory.block), memory.compactions
        memory.remember(experience)
        outcomes_since += 1
        assert len(memory.block) <= limit
        if memory.compactions == compactions:
            assert "".join(memory.block).startswith(before)
        else:
            assert outcomes_since > limit // 2, "a compaction is paid for by half a block of outcomes at least"
            assert len(memory.block) <= max(1, limit // 2)
            outcomes_since = 0


def test_recent_keeps_the_newest() -> None:
    memory = remembering("recent", 4, *map(past, "abcde"))
    assert words(memory.block) == "de"


def test_failures_keep_the_newest_of_each_sensor_those_that_failed_first() -> None:
    failed = {"a": (1, True), "b": (2, True), "c": (1, False), "d": (3, False), "e": (4, True), "f": (5, False)}
    pasts = [Experience(line, sensor, lost) for line, (sensor, lost) in failed.items()]
    assert words(remembering("failures", 5, *pasts).block) == "be"
    assert words(remembering("failures", 5, *pasts, *pasts[:1] * 4).block) == "ea"
    memory = remembering("failures", 5, *pasts)
    again = Experiences(5, "failures")
    again.load_state_dict(memory.state_dict())
    for one in (memory, again):
        for experience in (*pasts[:3], *pasts[3:4] * 2):
            one.remember(experience)
    assert again.block == memory.block


def test_experiences_of_an_earlier_version_are_read() -> None:
    memory = Experiences(2, "failures")
    earlier = [["a", 0.5, None, 1, True], ["b", 0.0, None, 2, False]]
    memory.load_state_dict({"block": ["a", "b"], "compactions": 3, "since": 1, "remembered": earlier})
    memory.remember(Experience("c", 3, False))
    assert memory.block == ["a"] and memory.compactions == 4


def test_memory_is_bounded() -> None:
    failed = Experience("failed", 1, True)
    memory = remembering("failures", 4, failed, *(Experience("fine", 0, False) for _ in range(300)))
    assert "failed" not in memory.block


def flown(selection: Selection, steps: int) -> list[tuple[str, str, str]]:
    """The prompts' three blocks over a mission whose UAV flies east past six sensors."""
    spec = MissionSpec(prompt=PromptStyle(selection=selection, experiences=4), top_k=3)
    m, prompts = mission(spec), []
    for step in range(steps):
        view = attended(m, uav(step=step, position=(400.0 + 20 * step, 500.0)), step)
        prompt = m.template.prompt(view.state, view.shown(), m.experiences.block)
        prompts.append((prompt.static, prompt.experiences, prompt.state))
        m.commit(view.pending(f"{step:032x}", Action(view.kept_ids[step % 3], 7)))
        m.apply(Outcome(decision_id=f"{step:032x}", cost=step % 5 / 2))
    return prompts


@pytest.mark.parametrize("selection", SELECTIONS)
def test_the_cached_blocks_grow_at_their_end_but_for_compactions(selection: Selection) -> None:
    prompts = flown(selection, 12)
    assert len({static for static, _, _ in prompts}) == 1
    changes = sum(not later[1].startswith(earlier[1]) for earlier, later in itertools.pairwise(prompts))
    assert changes == 3


def test_a_mission_says_how_it_selects_and_the_service_has_a_default() -> None:
    assert status_of(mission()).prompt.selection == "recent"
    assert status_of(mission(selection="failures")).prompt.selection == "failures"
    spec = MissionSpec(prompt=PromptStyle(selection="recent"))
    assert status_of(mission(spec, selection="failures")).prompt.selection == "recent"


@pytest.mark.parametrize("earlier", ["similar", "best"])
def test_a_selection_of_the_first_version_is_failures(earlier: str) -> None:
    assert PromptStyle.model_validate({"selection": earlier}).selection == "failures"
    assert Settings.model_validate({"selection": earlier}).selection == "failures"
