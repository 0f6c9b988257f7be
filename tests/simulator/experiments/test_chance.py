"""The server that answers at random: only what is allowed, the same to the same question."""

from __future__ import annotations

from collections import Counter

import httpx
import pytest

from simulator.experiments.chance import MODEL, answering_at_random, drawn


def body(user: str = "rows", grammar: str | None = 'root ::= ("3" | "17") " " ("0" | "1" | "2")') -> dict[str, object]:
    return {"messages": [{"role": "user", "content": user}], "grammar": grammar}


def test_every_allowed_answer_comes_about_equally_often() -> None:
    counted = Counter(drawn(body(f"rows {n}")) for n in range(3000))
    assert set(counted) == {f"{sensor} {velocity}" for sensor in (3, 17) for velocity in (0, 1, 2)}
    assert all(400 < count < 600 for count in counted.values())


def test_the_same_question_gets_the_same_answer() -> None:
    assert len({drawn(body()) for _ in range(5)}) == 1


@pytest.mark.parametrize("grammar", [None, "", 'root ::= "3"'])
def test_a_request_without_a_grammar_of_two_numbers_is_refused(grammar: str | None) -> None:
    with answering_at_random() as url:
        assert httpx.post(f"{url}/chat/completions", json=body(grammar=grammar)).status_code == 400
        assert httpx.get(f"{url}/models").json()["data"][0]["id"] == MODEL
