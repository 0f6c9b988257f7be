"""The servers in place of an LLM: allowed answers only, equal for equal requests."""

from __future__ import annotations

from collections import Counter

import httpx
import pytest

from lab.experiments.stand_ins import answering, drawn, worst


def body(user: str = "rows", grammar: str | None = 'root ::= ("3" | "17") " " ("0" | "1" | "2")') -> dict[str, object]:
    return {"messages": [{"role": "user", "content": user}], "grammar": grammar}


def test_every_allowed_answer_comes_about_equally_often() -> None:
    counted = Counter(drawn(body(f"rows {n}")) for n in range(3000))
    assert set(counted) == {f"{sensor} {velocity}" for sensor in (3, 17) for velocity in (0, 1, 2)}
    assert all(400 < count < 600 for count in counted.values())


def test_the_same_question_gets_the_same_answer() -> None:
    assert len({drawn(body()) for _ in range(5)}) == 1


@pytest.mark.parametrize("grammar", [None, "", 'root ::= "3"', "root ::= [0-9]"])
def test_a_request_without_such_a_grammar_is_refused(grammar: str | None) -> None:
    with answering(drawn) as url:
        assert httpx.post(f"{url}/chat/completions", json=body(grammar=grammar)).status_code == 400
        assert httpx.get(f"{url}/models").json()["data"][0]["id"] == "uniform draws"


LETTERS = 'root ::= "A" | "B" | "C" | "D" | "E" | "F"'


def test_a_letter_is_drawn_as_well() -> None:
    assert {drawn(body(f"rows {n}", LETTERS)) for n in range(200)} == set("ABCDEF")


def test_the_worst_is_the_emptiest_queue_at_its_fastest() -> None:
    assert worst(body("A52,3,0-14\nC7,1,2-9\nE60,2,4", LETTERS)) == "D"
    assert worst(body("A52,3,0-14\nC17,1,2-9\nE6,2,4", LETTERS)) == "F"
    with answering(worst) as url:
        answer = httpx.post(f"{url}/chat/completions", json=body("A1,0,3", LETTERS)).json()
        assert answer["choices"][0]["message"]["content"] == "F"
        # An edge first requests a pair, as its probe of the grammar.
        assert httpx.post(f"{url}/chat/completions", json=body()).status_code == 200
        assert httpx.post(f"{url}/chat/completions", json=body(grammar=None)).status_code == 400
