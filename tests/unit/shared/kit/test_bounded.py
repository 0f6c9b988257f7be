"""Dicts that forget what was added first."""

from shared.kit.bounded import BoundedDict


def test_the_oldest_of_too_many_is_forgotten() -> None:
    bounded = BoundedDict[str, int](2)
    for n, key in enumerate("abc"):
        bounded[key] = n
    assert list(bounded.items()) == [("b", 1), ("c", 2)]


def test_a_key_set_again_keeps_its_place_and_counts_once() -> None:
    bounded = BoundedDict[str, int](2)
    for key in "abaa":
        bounded[key] = 0
    assert list(bounded) == ["a", "b"]
    bounded["c"] = 0
    assert list(bounded) == ["b", "c"]


def test_entries_count_by_weight_and_a_single_one_is_kept() -> None:
    bounded = BoundedDict[str, str](5, len)
    bounded["a"], bounded["b"] = "xx", "xxx"
    assert list(bounded) == ["a", "b"]
    bounded["c"] = "xxxxxxx"
    assert list(bounded) == ["c"]
    bounded["d"] = "x"
    assert list(bounded) == ["d"]


def test_what_is_taken_or_deleted_leaves_room() -> None:
    bounded = BoundedDict[str, str](3, len)
    bounded["a"], bounded["b"] = "xx", "x"
    assert (bounded.take("a"), bounded.take("a")) == ("xx", None)
    bounded["c"] = "xx"
    assert list(bounded) == ["b", "c"]
    bounded.clear()
    bounded["d"], bounded["e"] = "xx", "x"
    assert list(bounded) == ["d", "e"]
