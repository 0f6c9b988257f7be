import itertools
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.api.mission_answers import status_of
from service.prompting.experiences import Experience, Experiences
from shared.wire.schemas import MissionSpec, Outcome, PromptStyle, Selection
from shared.world.step_rule import Action
from tests.support.missions import attended, mission, uav

SELECTIONS: tuple[Selection, ...] = get_args(Selection)


def past(line: str, cost: float = 0.0, *features: float) -> Experience:
    return Experience(f"{line}\n", cost, np.array(features, dtype=np.float32) if features else None, 0, False)


def remembering(selection: Selection, limit: int, *experiences: Experience, uavs: int = 1) -> Experiences:
    memory = Experiences(limit, selection, uavs)
    for experience in experiences:
        memory.remember(experience)
    return memory


def words(lines: list[str]) -> str:
    return "".join(lines).replace("\n", "")


# Alike lines, equal costs and decisions without the modules' part are all drawn, and often.
PASTS = st.builds(
    past, st.sampled_from("abcdef"), st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0.0, 0.2, 1.0]), st.just(0.5)
) | st.builds(past, st.sampled_from("abc"))


@given(st.sampled_from(SELECTIONS), st.integers(0, 9), st.integers(1, 4), st.lists(PASTS, max_size=60))
def test_between_compactions_the_block_only_grows(
    selection: Selection, limit: int, uavs: int, pasts: list[Experience]
) -> None:
    memory = Experiences(limit, selection, uavs)
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
    pasts = [Experience(line, 0.0, None, sensor, lost) for line, (sensor, lost) in failed.items()]
    assert words(remembering("failures", 5, *pasts).block) == "be"
    assert words(remembering("failures", 5, *pasts, *pasts[:1] * 4).block) == "ea"
    memory = remembering("failures", 5, *pasts)
    again = Experiences(5, "failures")
    again.load_state_dict(memory.state_dict())
    for one in (memory, again):
        for experience in (*pasts[:3], *pasts[3:4] * 2):
            one.remember(experience)
    assert again.block == memory.block


def test_best_keeps_the_lowest_costs_and_some_of_the_highest_as_warnings() -> None:
    costs = {"a": 0.1, "b": 3.0, "c": 0.4, "d": 0.0, "e": 1.0, "f": 0.2, "g": 2.0, "h": 0.3, "i": 0.5}
    memory = remembering("best", 8, *(past(line, cost) for line, cost in costs.items()))
    assert words(memory.block) == "bfad"
    # A later compaction ranks all that is remembered, also what left the block.
    for line, cost in {"j": 5.0, "k": 0.25, "l": 0.6, "m": 0.7, "n": 0.8}.items():
        memory.remember(past(line, cost))
    assert memory.compactions == 2
    assert words(memory.block) == "jfad"


def test_of_equal_costs_the_newest_are_the_best_and_alike_lines_count_once() -> None:
    memory = remembering("best", 4, *map(past, "abacc"))
    assert words(memory.block) == "ac"


def test_similar_chooses_those_nearest_to_the_fleets_newest_decisions() -> None:
    pasts = [past("a", 0, 0.9), past("b", 0, 0.15), past("c", 0, 0.5), past("d", 0, 0.1)]
    assert words(remembering("similar", 4, *pasts).block) == "bd"
    assert words(remembering("similar", 4, *pasts[:3], past("d", 0, 0.9)).block) == "ad"
    both = remembering(
        "similar", 4, past("a", 0, 0.4), past("b", 0, 0.15), past("c", 0, 0.9), past("d", 0, 0.1), uavs=2
    )
    assert words(both.block) == "cd"


def test_the_nearest_to_the_rows_at_hand_is_retrieved_unless_the_block_has_it() -> None:
    memory = remembering("similar", 4, *(past(line, 0, x) for line, x in zip("abc", (0.9, 0.2, 0.5), strict=True)))
    assert memory.block == []
    assert memory.nearest(np.array([[0.21]], np.float32)) == ["b\n"]
    assert memory.nearest(np.array([[0.0], [0.52]], np.float32)) == ["c\n"]
    memory.remember(past("d", 0, 0.19))
    assert words(memory.block) == "bd"
    assert memory.nearest(np.array([[0.21]], np.float32)) == []
    assert memory.nearest(np.array([[1.0]], np.float32)) == ["a\n"]
    assert memory.nearest(np.empty((0, 1), np.float32)) == []


@pytest.mark.parametrize("selection", ["recent", "best"])
def test_only_similar_retrieves(selection: Selection) -> None:
    memory = remembering(selection, 2, *(past(line, 0, 0.5) for line in "abcd"))
    assert memory.nearest(np.array([[0.5]], np.float32)) == []


def test_a_decision_without_the_modules_part_is_like_no_other() -> None:
    memory = remembering("similar", 2, past("a"), past("b"))
    assert memory.block == []
    assert memory.nearest(np.array([[0.5]], np.float32)) == []


def test_memory_is_bounded() -> None:
    memory = remembering("best", 4, past("cheap", 0.0), *(past(str(n), 1.0) for n in range(300)))
    assert "cheap\n" not in memory.block


def flown(selection: Selection, steps: int, **style: Any) -> list[tuple[str, str, str]]:
    """The prompts' three blocks over a mission whose UAV flies east past six sensors."""
    spec = MissionSpec(prompt=PromptStyle(selection=selection, experiences=4, **style), top_k=3)
    m, prompts = mission(spec), []
    for step in range(steps):
        view = attended(m, uav(step=step, position=(400.0 + 20 * step, 500.0)), step)
        prompt = m.template.prompt(view.state, view.shown(), m.experiences.block, view.similar_experiences())
        prompts.append((prompt.static, prompt.experiences, prompt.state))
        m.commit(view.pending(f"{step:032x}", Action(view.kept_ids[step % 3], 7)))
        m.apply(Outcome(decision_id=f"{step:032x}", cost=step % 5 / 2))
    return prompts


def test_what_is_retrieved_stands_in_the_last_block() -> None:
    prompts = flown("similar", 12)
    assert len({static for static, _, _ in prompts}) == 1
    plain = flown("recent", 12)
    rows = len(plain[0][2].splitlines())
    extra = [len(state.splitlines()) - rows for _, _, state in prompts]
    assert extra[0] == 0
    assert max(extra) == 1
    changes = sum(later[1] != earlier[1] for earlier, later in itertools.pairwise(prompts))
    assert changes == 2, "the cached block changes at a compaction alone, every fourth outcome"


def test_a_mission_says_how_it_selects_and_the_service_has_a_default() -> None:
    assert status_of(mission()).prompt.selection == "recent"
    assert status_of(mission(selection="best")).prompt.selection == "best"
    spec = MissionSpec(prompt=PromptStyle(selection="similar"))
    assert status_of(mission(spec, selection="best")).prompt.selection == "similar"
