"""Request bodies that follow a server's refusals."""

from __future__ import annotations

import time
from typing import Any

import pytest

from service.llm.answer_reading import excerpt, pause_of
from service.llm.request_bodies import RequestTerms, chat_body, label_body


def body() -> dict[str, Any]:
    return label_body("m", "instructions", "state", "none", [["A", "B"]], "top_20")


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("Use 'max_completion_tokens' instead of max_tokens", {"max_tokens": "max_completion_tokens"}),
        ("temperature: Extra inputs are not permitted", {"temperature": False}),
        ("Requested sample logprobs of 20, which is greater than max allowed: 5", {"top_logprobs": 5}),
        ("messages[0].role: Unsupported value", {"system_role": False}),
        ("Conversation roles must alternate user/assistant/user/assistant/...", {"system_role": False}),
        ("max_tokens: context length of 2048 is exceeded", None),
        ("The model does not exist", None),
        ("unknown field: grammar", None),
    ],
)
def test_a_refusal_that_names_a_field_changes_it(message: str, changes: dict[str, Any] | None) -> None:
    found = RequestTerms().after_refusal(message, body())
    assert found == (None if changes is None else RequestTerms(**changes))


def test_no_field_is_changed_twice_without_end() -> None:
    terms, count = RequestTerms(), 0
    message = "logprobs, max_tokens, temperature, seed and the system role are not supported"
    while other := terms.after_refusal(message, terms.applied({**body(), "seed": 1})):
        terms, count = other, count + 1
    assert count == 6
    assert terms.applied({**body(), "seed": 1}).keys() == {"messages", "max_completion_tokens", "stream", "model"}


def test_a_server_that_asks_for_more_tokens_again_gets_no_more() -> None:
    """It would refuse the same request for ever."""
    message = "max_output_tokens: integer below minimum value"
    more = RequestTerms().after_refusal(message, body())
    assert more == RequestTerms(more_tokens=256)
    assert more.after_refusal(message, more.applied(body())) is None


def test_terms_never_raise_the_number_of_token_probabilities() -> None:
    few = label_body("m", "instructions", "state", "none", [["A", "B"]], "top_5")
    assert RequestTerms(seed=False).applied(few)["top_logprobs"] == 5


def test_usual_terms_leave_a_body_alone_and_others_leave_the_given_one() -> None:
    usual = chat_body("m", "instructions", "state", "none", [1], 15)
    assert RequestTerms().applied(usual) is usual
    folded = RequestTerms(system_role=False, more_tokens=256).applied(usual)
    assert folded["messages"] == [{"role": "user", "content": "instructions\n\nstate"}]
    assert folded["max_tokens"] == usual["max_tokens"] + 256
    assert [message["role"] for message in usual["messages"]] == ["system", "user"]


@pytest.mark.parametrize(
    ("most", "budgets"), [(0, []), (100, [100]), (2048, [256, 1024, 2048]), (4096, [256, 1024, 4096])]
)
def test_tokens_for_thought_are_raised_to_the_setting(most: int, budgets: list[int]) -> None:
    terms, found = RequestTerms(), []
    while other := terms.with_more_tokens(most):
        terms = other
        found.append(terms.more_tokens)
    assert found == budgets


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b'{"error": {"message": "bad key sk-abc123def", "param": "model"}}', "model: bad key ***"),
        (b'{"detail": [{"loc": ["body", "seed"], "msg": "no"}]}', "['body', 'seed']: no"),
        (b"<html><style>p {}</style><h1>502</h1>Bad\n\ngateway</html>", "502 Bad gateway"),
        (b"Incorrect key private-1 at http://user:pw@host", "Incorrect key *** at http://***host"),
        (b"\xff\x00" * 1000, None),
        (b"{" * 100_000, "{" * 200),
    ],
)
def test_an_excerpt_is_short_readable_and_without_keys(content: bytes, expected: str | None) -> None:
    found = excerpt(content, ("private-1",))
    assert len(found) <= 200 and found.isprintable()
    assert expected is None or found == expected


@pytest.mark.parametrize(
    ("value", "seconds"),
    [
        ("3", 3.0),
        ("0.5", 0.5),
        ("0", 0.1),
        ("-4", 0.1),
        ("1e9", 480.0),
        ("nan", None),
        ("soon", None),
        ("", None),
        (f"Fri, 31 Dec {9 * 10**20} 00:00:00 GMT", None),
        (f"Fri, 31 Dec 2020 00:00:00 +{10**20}", None),
    ],
)
def test_a_pause_is_bounded_and_nonsense_is_none(value: str, seconds: float | None) -> None:
    assert pause_of({"Retry-After": value} if value else {}) == seconds


def test_a_pause_may_be_a_date() -> None:
    assert pause_of({"Retry-After": "Fri, 31 Dec 2100 23:59:59 GMT"}) == 480.0
    assert pause_of({"Retry-After": "Fri, 31 Dec 1999 23:59:59 GMT"}) == 0.1


def test_a_date_of_an_unknown_zone_is_read_as_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    """RFC 5322 writes -0000 where the zone is unknown; the machine's own zone says nothing about the server."""
    monkeypatch.setenv("TZ", "Etc/GMT+12")
    time.tzset()
    try:
        past = time.strftime("%a, %d %b %Y %H:%M:%S -0000", time.gmtime(time.time() - 60))
        assert pause_of({"Retry-After": past}) == 0.1
    finally:
        monkeypatch.undo()
        time.tzset()
