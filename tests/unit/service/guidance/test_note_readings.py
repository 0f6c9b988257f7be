"""Reading notes with the orders' adapter and by rules: their agreement, and doubts where there is none."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, cast

import pytest

from service.guidance.lettered_orders import STATIC
from service.guidance.note_compiler import compile_note
from service.guidance.note_orders import BadOrders
from service.guidance.note_phrases import PhrasedNote
from service.guidance.plain_reading import confirms, plain_reading
from service.llm.answers import Completion
from service.llm.request_bodies import Rewriting
from service.llm.server_pool import ServerPool
from shared.planning.orders import Guidance, Impossible, SensorWish
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]
NOTE = "Sensor 4 every 3 steps, and nobody exceeds 9 m/s."
MEANT = Guidance(sensors=[SensorWish(sensor_id=4, visit_every=3)], max_velocity=9)
RIGHT, OTHER = "visit {0} every {1}; max {2}", "visit {0} every {1}; min {2}"


class Adapted:
    """An embedded LLM with the orders' adapter that says this of the note's letters, one answer a reading."""

    reads_letters = True

    def __init__(self, answers: Sequence[str]) -> None:
        self._answers = iter(answers)
        self.read: list[str] = []

    async def rewrite(self, wanted: Rewriting, *, temperature: float, seed: int) -> Completion:
        fields = wanted.constrain("grammar")
        assert (wanted.instruction, temperature) == (STATIC, 0.0)
        letters = re.findall(r"\b[A-Z]\b", wanted.text)
        assert all(f'"{letter}"' in fields["grammar"] for letter in letters)
        self.read.append(wanted.text)
        return Completion(next(self._answers).format(*letters), None, None, None)


async def reading(llm: Adapted, note: str = NOTE) -> Any:
    return await compile_note(PhrasedNote(note, PAPER, ()), PAPER, cast(ServerPool, llm))


@pytest.mark.parametrize("answers", [[RIGHT], [OTHER, RIGHT], ["unclear", OTHER, RIGHT]])
async def test_a_reading_that_the_rules_confirm_has_no_doubt_and_ends_the_search(answers: list[str]) -> None:
    llm = Adapted(answers)
    found = await reading(llm)
    assert (found.guidance, found.doubts) == (MEANT, ())
    assert len(set(llm.read)) == len(answers)


UNRULY = "Whatever you do, sensor 4 gets its 3 steps, and 9 m/s it is."


@pytest.mark.parametrize("answers", [[RIGHT, OTHER, RIGHT], [OTHER, RIGHT, RIGHT], [RIGHT, RIGHT, "unclear"]])
async def test_where_the_readings_differ_the_commonest_is_proposed_with_a_doubt(answers: list[str]) -> None:
    llm = Adapted(answers)
    found = await reading(llm, UNRULY)
    assert found.guidance == MEANT
    assert found.doubts == (f"“{UNRULY}” can be read in more than one way.",)
    assert len(set(llm.read)) == 3


async def test_a_reading_that_no_rule_confirms_has_a_doubt() -> None:
    found = await reading(Adapted([RIGHT] * 3), UNRULY)
    assert found.guidance == MEANT
    assert found.doubts == (f"No rule confirms the LLM's reading of “{UNRULY}”: compare the orders with it.",)


WORDY = "My dear, sensor 4 deserves a look in any 3 steps if I may say so, and 9 m/s would be my ceiling."


async def test_where_the_rules_read_nothing_equal_readings_that_words_confirm_have_no_doubt() -> None:
    assert plain_reading(WORDY, PAPER) is None
    found = await reading(Adapted([RIGHT] * 3), WORDY)
    assert (found.guidance, found.doubts) == (MEANT, ())
    assert (await reading(Adapted([OTHER] * 3), WORDY)).doubts
    assert (await reading(Adapted([RIGHT, RIGHT, OTHER]), WORDY)).doubts


@pytest.mark.parametrize(
    ("note", "orders", "confirmed"),
    [
        ("Sensor 4 wants a visit in 3 steps. The limit is 9.", {"visit:4": 3, "max_velocity": 9}, True),
        ("Sensor 4, 3. The limit is 9.", {"visit:4": 3, "max_velocity": 9}, False),
        ("9 m/s resonates with the gimbal. It is struck from the list.", {"min_velocity": 9}, False),
        ("Never fly at 9 m/s.", {"avoid:9": 9}, True),
        ("Hover nowhere.", {"avoid:0": 0}, True),
        ("Sensor 4 is nice.", {"weight:4": 0.0}, False),
        ("Sensor 4 is dead.", {"weight:4": 0.0}, True),
        ("What sensor 4 loses counts double.", {"weight:4": 2.0}, True),
        ("Up to 36 km/h.", {"max_velocity": 10}, True),
        ("The yard sees to its own sensor 7 every 3 steps, nothing to do with us.", {"visit:7": 3}, False),
        ("Sensor 7 gets a visit every 3 steps. I only pass this on.", {"visit:7": 3}, False),
    ],
)
def test_a_word_of_its_kind_in_its_sentence_confirms_an_order(
    note: str, orders: dict[str, float], confirmed: bool
) -> None:
    assert confirms(note, orders) == confirmed


@pytest.mark.parametrize(
    ("often", "seconds"),
    [("twice a minute", "30 seconds"), ("three times an hour", "20 minutes"), ("10 times per hour", "6 minutes")],
)
def test_how_often_in_a_time_is_the_time_between(often: str, seconds: str) -> None:
    assert PhrasedNote(f"I want sensor 4 {often} at least.", PAPER, ()).text.endswith(f"every {seconds} at least.")


@pytest.mark.parametrize("answer", [OTHER, "unclear"])
async def test_where_the_llm_never_reads_as_the_rules_do_theirs_is_proposed_with_a_doubt(answer: str) -> None:
    found = await reading(Adapted([answer] * 3))
    assert found.guidance == MEANT
    assert found.doubts == (f"“{NOTE}” can be read in more than one way.",)


async def test_a_part_that_the_llm_finds_unclear_is_quoted() -> None:
    unclear = f"{RIGHT}; unclear"
    assert (await reading(Adapted([unclear] * 3))).doubts == (
        f"A part of the note is unclear, and is in no order: “{NOTE}”.",
    )
    # Where code finds the words that are in no order, it quotes just these.
    more = PhrasedNote(f"{NOTE[:-1]}, and be careful.", PAPER, ())
    found = await compile_note(more, PAPER, cast(ServerPool, Adapted([unclear] * 3)))
    assert (found.guidance, found.doubts) == (MEANT, ("In no order: “be careful”.",))


async def test_what_code_has_read_is_proposed_beside_what_is_unclear() -> None:
    note = PhrasedNote("Cancel all orders, and Kim looks after sensor 4.", PAPER, ("visit:4",))
    found = await compile_note(note, PAPER, cast(ServerPool, Adapted(["unclear"] * 3)))
    assert (note.withdrawn, found.guidance) == (["*"], Guidance())
    assert found.doubts[0].startswith("In no order: “kim looks after sensor 4.”: the note is unclear")


async def test_a_note_that_most_readings_find_unclear_is_refused() -> None:
    with pytest.raises(BadOrders, match="is unclear"):
        await reading(Adapted(["unclear", RIGHT, "unclear"]), UNRULY)


async def test_what_the_fleet_cannot_do_is_refused() -> None:
    with pytest.raises(Impossible, match="sensor 9 is unknown"):
        llm = cast(ServerPool, Adapted([RIGHT] * 3))
        few = PAPER.model_copy(update={"sensors": 5})
        await compile_note(PhrasedNote(NOTE.replace("4", "9"), few, ()), few, llm)


async def test_more_than_twenty_numbers_are_refused() -> None:
    with pytest.raises(BadOrders, match="more than 20"):
        await compile_note(PhrasedNote("1 " * 21, PAPER, ()), PAPER, cast(ServerPool, Adapted([])))
