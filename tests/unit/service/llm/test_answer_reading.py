"""Chat completions as servers really send them."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from service.llm.answer_reading import completion_of, streamed
from service.llm.answers import NoDecision


def answer(content: Any, **choice: Any) -> dict[str, Any]:
    return {"choices": [{"message": {"content": content}, **choice}]}


def position(token: str, *likeliest: Any) -> dict[str, Any]:
    return {"token": token, "top_logprobs": list(likeliest)}


def entry(token: str, probability: float) -> dict[str, Any]:
    return {"token": token, "logprob": math.log(probability)}


@pytest.mark.parametrize("blank", ["Ġ", "▁", " ", ""])
def test_a_token_may_begin_with_the_blank_of_its_vocabulary_and_an_entry_may_be_null(blank: str) -> None:
    content = [position(f"{blank}A", None, entry(f"{blank}A", 0.9), entry(f"{blank}B", 0.1))]
    read = completion_of(answer("A", logprobs={"content": content}), "url")
    assert read.positions[0].likeliest == pytest.approx({"A": 0.9, "B": 0.1})


def test_positions_of_thoughts_are_none_of_the_answer() -> None:
    tokens = ["<think>", "Hm", "</think>", "\n\n", "B"]
    content = [position(token, entry(token, 0.8), entry("A", 0.1)) for token in tokens]
    read = completion_of(answer("<think>Hm</think>\n\nB", logprobs={"content": content}), "url")
    assert read.text == "B"
    assert [found.token for found in read.positions] == ["B"]


@pytest.mark.parametrize(
    ("content", "text", "unfinished"),
    [
        ("", "", True),
        (None, "", True),
        ("<think>Hm", "", True),
        ("<thinking>Hm", "", True),
        # White space without end is no thought: more tokens would be more of it.
        ("{\n\n\n", "{\n\n\n", False),
        (" \n ", " \n ", False),
        ("0 7", "0 7", False),
        ("A", "A", False),
        # Thoughts that the chat template opens in the prompt have no tag before their end.
        ("Okay, so I need to pick", "Okay, so I need to pick", True),
        # A small model that rambles would do so in any number of tokens.
        ("Hello! How can I", "Hello! How can I", False),
        ('{\n "sensor_id": 0', '{\n "sensor_id": 0', True),
    ],
)
def test_an_answer_cut_off_before_it_begins_is_unfinished(content: str | None, text: str, unfinished: bool) -> None:
    read = completion_of(answer(content, finish_reason="length"), "url")
    assert (read.text, read.unfinished) == (text, unfinished)


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("`0 7`", "0 7"),
        ("*0 7*", "0 7"),
        ("<answer>0 7</answer>", "0 7"),
        ("<|begin_of_box|>0 7<|end_of_box|>", "0 7"),
        ("<seed:think>Hm</seed:think>0 7", "0 7"),
        ("◁think▷Hm◁/think▷0 7", "0 7"),
        ("<|START_THINKING|>Hm<|END_THINKING|><|START_RESPONSE|>A<|END_RESPONSE|>", "A"),
        ("<|begin_of_thought|>Hm<|end_of_thought|>\n\n0 7", "0 7"),
        ("0 7<eos>", "0 7"),
        ("0 7<pad><pad>", "0 7"),
        ("```A```", "A"),
        ("```\nA\nB\n```", "A\nB"),
        ("```text\nA\n```", "A"),
        ('```json {"sensor_id": 0, "velocity": 7}```', '{"sensor_id": 0, "velocity": 7}'),
    ],
)
def test_marks_around_an_answer_are_none_of_it(text: str, answer: str) -> None:
    assert completion_of({"choices": [{"message": {"content": text}}]}, "url").text == answer


@pytest.mark.parametrize(
    "message",
    [
        {"content": [{"type": "output_text", "text": "0 7"}]},
        {"content": [{"text": "0 7"}]},
        {"content": ["0 ", "7"]},
        {"content": [{"type": "thinking", "text": "Hm"}, {"type": "text", "text": "0 7"}]},
        {"content": None, "function_call": {"name": "decide", "arguments": "0 7"}},
    ],
)
def test_an_answer_may_come_in_parts_of_any_kind(message: dict[str, Any]) -> None:
    assert completion_of({"choices": [{"message": message}]}, "url").text == "0 7"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"error": {"message": "no such model"}}, "no such model"),
        ({"error": "Unexpected endpoint"}, "Unexpected endpoint"),
        ({"choices": []}, "no chat completion"),
        (answer(None, finish_reason="stop"), "without text"),
        (answer(7), "without text"),
    ],
)
def test_no_completion_is_named_in_the_servers_words(body: Any, words: str) -> None:
    with pytest.raises(NoDecision, match=words):
        completion_of(body, "url")


def test_no_error_quotes_the_key() -> None:
    with pytest.raises(NoDecision, match="bad key \\*\\*\\*"):
        completion_of({"error": {"message": "bad key private-1"}}, "url", ("private-1",))


@pytest.mark.parametrize(
    "text",
    [
        " " * 250_000 + "x",
        "<|im_end|>" * 25_000,
        "<think>" * 35_000,
        '"' + '" ' * 125_000 + "x",
        "```\n" * 60_000,
        "```json" + "\n" * 250_000 + "x",
        "```" + " \n" * 120_000 + "0 7",
    ],
    ids=["blanks", "special tokens", "thoughts", "quotes", "fences", "an open fence", "blanks in an open fence"],
)
def test_a_hostile_text_is_read_in_time_linear_in_its_length(text: str) -> None:
    # A quadratic reader would take minutes, and the test's time limit ends it.
    assert completion_of({"choices": [{"message": {"content": text}}]}, "http://llm").text is not None


@pytest.mark.parametrize("first", ["A", "Okay"])
def test_of_thoughts_given_apart_no_token_is_the_answers(first: str) -> None:
    """vLLM with a reasoning parser: the text without the thoughts, the log-probabilities with them."""
    content = [
        position(first, entry("A", 0.5), entry("Okay", 0.4)),
        position("</think>", entry("</think>", 0.99)),
        position("\n\n", entry("\n\n", 0.99)),
        position("C", entry("A", 0.01), entry("C", 0.96)),
    ]
    body = {"choices": [{"message": {"content": "C", "reasoning_content": "A ..."}, "logprobs": {"content": content}}]}
    read = completion_of(body, "url")
    assert read.text == "C" and read.positions[0].likeliest["C"] == pytest.approx(0.96)


def test_a_stream_may_have_any_separator_in_its_text() -> None:
    parts = [{"choices": [{"delta": {"content": text}}]} for text in ("0\u2028", "\u0085 7")]
    events = "".join(f"data: {json.dumps(part, ensure_ascii=False)}\r\n\r\n" for part in parts)
    assert completion_of(streamed(events.encode()), "url").text == "0\u2028\u0085 7"


def test_a_probability_above_one_is_none() -> None:
    likeliest = [{"token": "A", "prob": 1.5}, {"token": "B", "prob": 1.0}, {"token": "C", "prob": -0.1}]
    read = completion_of(answer("B", logprobs={"content": [{"token": "B", "top_probs": likeliest}]}), "url")
    assert read.positions[0].likeliest == {"B": 1.0}


def test_no_more_tokens_are_cached_than_the_prompt_has() -> None:
    usage = {"prompt_tokens": 300, "completion_tokens": 4, "prompt_tokens_details": {"cached_tokens": 512}}
    read = completion_of({**answer("0 7"), "usage": usage}, "url")
    assert (read.prompt_tokens, read.cached_tokens, read.completion_tokens) == (300, 300, 4)


def test_of_two_tool_calls_none_is_the_answer() -> None:
    calls = [{"function": {"arguments": f'{{"sensor_id": {sensor}, "velocity": 3}}'}} for sensor in (0, 1)]
    assert "0" in completion_of({"choices": [{"message": {"tool_calls": calls[:1]}}]}, "url").text
    with pytest.raises(NoDecision, match="a completion without text"):
        completion_of({"choices": [{"message": {"tool_calls": calls}}]}, "url")
