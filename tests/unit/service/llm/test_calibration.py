"""An LLM's probabilities of labels: read, corrected for its bias, sharpened."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest

from service.llm.answers import Completion, NoDecision, TokenPosition, raised
from service.llm.calibration import LabelReader, calibrated, probabilities
from tests.support.waiting import soon


def completion(text: str, **first_token: float) -> Completion:
    return Completion(text, None, None, None, (TokenPosition(text, first_token),) if first_token else ())


def test_calibration_takes_a_favourite_label_away() -> None:
    """An LLM that says A whatever is asked, and prefers B a little where B is better."""
    bias = {"A": 0.9, "B": 0.05, "C": 0.05}
    reported = {"A": 0.85, "B": 0.11, "C": 0.04}
    assert max(reported, key=lambda label: reported[label]) == "A"
    corrected = calibrated(reported, bias)
    assert max(corrected, key=lambda label: corrected[label]) == "B"
    assert sum(corrected.values()) == pytest.approx(1.0)
    # What says no more than the bias says nothing.
    assert calibrated(bias, bias) == pytest.approx(dict.fromkeys("ABC", 1 / 3))


def test_a_label_that_is_hardly_ever_drawn_gets_no_more_than_tenfold_its_uniform_weight() -> None:
    corrected = calibrated({"A": 0.5, "B": 0.5}, {"A": 1.0, "B": 1e-9})
    assert corrected["B"] / corrected["A"] == pytest.approx(20.0)


def test_sharpened_probabilities_are_nearer_to_a_choice() -> None:
    reported = {"A": 0.5, "B": 0.25, "C": 0.25}
    assert raised(reported, 1.0) == pytest.approx(reported)
    assert raised(reported, 4.0) == pytest.approx({"A": 16 / 18, "B": 1 / 18, "C": 1 / 18})
    assert raised({"A": 1e-12, "B": 1e-300}, 4.0) == pytest.approx({"A": 1.0, "B": 0.0})


def test_probabilities_come_from_the_tokens_told_or_else_from_the_answer() -> None:
    def reported(made: Completion, labels: str) -> dict[str, float]:
        return probabilities(made, [labels])[0]

    assert reported(completion("x", A=0.6, B=0.2, the=0.2), "AB") == pytest.approx({"A": 0.75, "B": 0.25})
    # C was not among the likeliest tokens.
    assert reported(completion("A", A=0.6, B=0.2), "ABC")["C"] == pytest.approx(0.1 / 0.9)
    assert reported(completion(" B\n"), "AB") == pytest.approx({"A": 0.025, "B": 0.975})
    with pytest.raises(NoDecision):
        reported(completion("hello", the=1.0), "AB")


def test_several_lists_are_read_place_by_place_or_line_by_line() -> None:
    likeliest = {"A": 0.9, "B": 0.1}, {"\n": 1.0}, {"C": 0.5, "B": 0.2, "A": 0.3}
    places = tuple(TokenPosition(token, reported) for token, reported in zip(("A", "\n", "B"), likeliest, strict=True))
    read = probabilities(Completion("A\nB", None, None, None, places), ["AB", "AB"])
    assert read == [pytest.approx({"A": 0.9, "B": 0.1}), pytest.approx({"A": 0.6, "B": 0.4})]
    # Of the second label no probabilities came: then the text counts, for both.
    read = probabilities(Completion("A\nB", None, None, None, places[:2]), ["AB", "AB"])
    assert [max(place, key=lambda label: place[label]) for place in read] == ["A", "B"]
    for text in ("A", "A\nB\nA", "A\nC", ""):
        with pytest.raises(NoDecision):
            probabilities(completion(text), ["AB", "AB"])


def test_a_single_label_is_read_where_it_should_stand_though_something_else_was_drawn() -> None:
    """ServerPool that cannot be held to the labels begin with a line's end, say."""
    (reported,) = probabilities(
        Completion("\n", None, None, None, (TokenPosition("\n", {"": 0.6, "A": 0.3, "B": 0.1}),)), ["AB"]
    )
    assert reported == pytest.approx({"A": 0.75, "B": 0.25})


def test_a_certain_answer_leaves_no_label_without_a_bias() -> None:
    (bias,) = probabilities(completion("E", E=1.0, F=5e-324), ["ABEF"])
    assert min(bias.values()) > 0
    corrected = calibrated({"A": 0.5, "B": 0.5}, bias)
    assert corrected == pytest.approx({"A": 0.5, "B": 0.5})


def test_a_low_temperature_is_undone() -> None:
    p = {"A": 0.6, "B": 0.3, "C": 0.1}
    cooled = {label: value**5 / sum(v**5 for v in p.values()) for label, value in p.items()}
    assert raised(cooled, 0.2) == pytest.approx(p)
    assert raised({}, 0.2) == {}


def test_labels_with_hardly_any_probability_are_no_answer() -> None:
    """A thinking model begins with another token; renormalised, its labels would seem sure."""
    with pytest.raises(NoDecision, match="the labels have 3e-07 of the probability"):
        probabilities(completion("<think>", **{"<think>": 0.99, "A": 2e-7, "B": 1e-7}), [["A", "B"]])


def test_a_bias_of_token_probabilities_corrects_no_answer_read_from_the_text() -> None:
    reader = LabelReader()
    reader._bias["model", "static", 1] = [{"A": 0.9, "B": 0.1}]
    other = Completion("A", None, None, None, (TokenPosition("A", {"x": 1.0}),), "model")
    assert reader.read(other, "static", [["A", "B"]]) == [pytest.approx({"A": 0.975, "B": 0.025})]


def _measuring() -> bool:
    return any(task.get_name() == "calibration" for task in asyncio.all_tasks())


async def test_a_bias_that_cannot_be_measured_is_tried_three_times() -> None:
    asked: list[str] = []

    async def failing(static: str, text: str, lists: Sequence[Sequence[str]]) -> Completion:
        asked.append(text)
        raise NoDecision("llm_error", "no answer")

    reader = LabelReader()
    for count in range(1, 4):
        reader.calibrate(failing, "model", "static", ["nothing"], [["A", "B"]])
        await soon(lambda: not _measuring())
        assert len(asked) == count
    reader.calibrate(failing, "model", "static", ["nothing"], [["A", "B"]])
    assert not _measuring()
    # Another prompt's bias is another question.
    reader.calibrate(failing, "model", "other", ["nothing"], [["A", "B"]])
    assert _measuring()
    await reader.close()


@pytest.mark.parametrize(("models", "known"), [(("model", "model"), True), (("model", "other"), False)])
async def test_a_bias_is_of_the_answers_of_one_model_only(models: tuple[str, str], known: bool) -> None:
    answering = iter(models)

    async def ask(static: str, text: str, lists: Sequence[Sequence[str]]) -> Completion:
        return Completion("A", None, None, None, (TokenPosition("A", {"A": 0.8, "B": 0.2}),), next(answering))

    reader = LabelReader()
    reader.calibrate(ask, "model", "static", ["nothing", "N/A"], [["A", "B"]])
    await soon(lambda: not _measuring())
    assert reader.bias("model", "static") == ([pytest.approx({"A": 0.8, "B": 0.2})] if known else None)
    assert reader.bias("other", "static") is None


async def test_a_measurement_without_an_answer_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would else be the last one, of any model."""
    monkeypatch.setattr("service.llm.calibration.TIMEOUT_S", 0.0)

    async def silent(static: str, text: str, lists: Sequence[Sequence[str]]) -> Completion:
        await asyncio.Event().wait()
        raise AssertionError

    reader = LabelReader()
    reader.calibrate(silent, "model", "static", ["nothing"], [["A", "B"]])
    assert _measuring()
    await soon(lambda: not _measuring())
    assert reader.bias("model", "static") is None
    await reader.close()
