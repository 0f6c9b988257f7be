"""Rendezvous hashing: even, the same everywhere, and a lost name moves only its own keys."""

from __future__ import annotations

from collections import Counter

from service.llm.server_pool import weight

KEYS = [f"mission-{number}" for number in range(3000)]
NAMES = ["http://a:8080/v1", "http://b:8080/v1", "http://c:8080/v1"]


def first(key: str, names: list[str]) -> str:
    return max(names, key=lambda name: weight(key, name))


def test_keys_are_shared_out_evenly() -> None:
    found = Counter(first(key, NAMES) for key in KEYS)
    # Binomial, 1000 expected: five standard deviations.
    assert all(abs(found[name] - 1000) < 130 for name in NAMES)


def test_a_name_that_leaves_moves_its_own_keys_alone_and_evenly() -> None:
    left = [name for name in NAMES if name != NAMES[1]]
    moved = Counter(first(key, left) for key in KEYS if first(key, NAMES) == NAMES[1])
    assert all(first(key, left) == first(key, NAMES) for key in KEYS if first(key, NAMES) != NAMES[1])
    assert all(abs(moved[name] - 500) < 130 for name in left)


def test_the_weight_is_the_same_in_every_process_and_version() -> None:
    """Processes of different versions serve the same missions side by side."""
    assert (weight("default", "0"), weight("default", "1")) == (15866230775154335417, 3815097654809372691)


def test_key_and_name_do_not_run_together() -> None:
    assert weight("a", "bc") != weight("ab", "c")
