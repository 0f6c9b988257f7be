"""The notes that the orders' adapter is trained on."""

from __future__ import annotations

import re
from itertools import islice

import pytest

from lab.distilling.note_examples import note_examples, operators, phrasings
from service.guidance.lettered_orders import MOVE, NOTHING, UNCLEAR, meaning
from service.guidance.note_numbers import LetteredNote
from service.guidance.note_orders import BadOrders
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"].model_copy(update={"sensors": 120})
COUNT = 1500


@pytest.mark.parametrize("held_out", [False, True])
def test_every_note_has_orders_of_its_own_letters_that_mean_something(held_out: bool) -> None:
    refused = 0
    for example in islice(note_examples(5, held_out), COUNT):
        letters = set(re.findall(r"\b[A-Z]\b", example.orders))
        assert letters <= set(re.findall(r"\b[A-Z](?=th\b|\b)", example.text)), example
        # A phrasing may draw numbers that no order can have, such as a range from 9 to 4.
        try:
            note = LetteredNote.of(example.note, 0)
            renamed = str.maketrans("".join(letters_in_order(example.text)), "".join(note.numbers))
            meaning(example.orders.translate(renamed), note, PAPER)
        except BadOrders as error:
            refused += example.orders != UNCLEAR
            assert example.orders == UNCLEAR or not str(error).endswith("is no order"), (example, error)
    assert refused < COUNT / 8


def letters_in_order(text: str) -> list[str]:
    return re.findall(r"(?<![A-Za-z])[A-Z](?=th\b|\b)", text)


def test_notes_are_the_seeds_and_of_every_kind() -> None:
    first, again, other = (list(islice(note_examples(seed), COUNT)) for seed in (1, 1, 2))
    assert first == again != other
    kinds = {order.split(" ")[0] for example in first for order in example.orders.split("; ")}
    assert kinds == {"visit", "weigh", "ignore", "max", "min", "avoid", MOVE, "until", "for", UNCLEAR, NOTHING}
    assert all(len(example.text) < 500 for example in first)


def test_held_out_phrasings_and_operators_are_of_no_training_note() -> None:
    for kind in ("visit", "weight", "max", "unclear"):
        assert set(phrasings(kind, True)).isdisjoint(phrasings(kind, False))
        assert len(phrasings(kind, True)) >= 3
    names = [set(operator["leads"]) for held_out in (False, True) for operator in operators(held_out)]
    assert len(names) == len(set(map(frozenset, names))) == 14
