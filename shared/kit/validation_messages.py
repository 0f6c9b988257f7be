"""A validation error in plain English: what is wrong with a field, and which name may have been meant."""

import re
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from typing import Any

_PREFIXES = ("Value error, ", "Assertion failed, ")
# The field is named before the text: "queue: must be a valid number".
_SUBJECT = re.compile(r"^[A-Z][a-z]+ should ")
_PLAIN = {
    "missing": "is missing",
    "dict_type": "must be a JSON object",
    "model_type": "must be a JSON object",
    "model_attributes_type": "must be a JSON object",
    "list_type": "must be a list",
}


def problem_of(error: Mapping[str, Any], known: Collection[str] = ()) -> str:
    """The text for one of pydantic's errors.

    Args:
        error: one of ``ValidationError.errors()``.
        known: the names that fields have anywhere; an unknown field gets the nearest of them as a suggestion.
    """
    if error["type"] == "extra_forbidden" and error["loc"][-1] in known:
        return "there is no such field in this place"
    if error["type"] == "extra_forbidden":
        return f"there is no such field{suggestion(str(error['loc'][-1]), known)}"
    text = _PLAIN.get(error["type"], str(error["msg"]))
    for prefix in _PREFIXES:
        text = text.removeprefix(prefix)
    return _SUBJECT.sub("must ", text)


def suggestion(name: str, known: Collection[str]) -> str:
    """``; did you mean X?`` with the nearest known name; empty where none is near."""
    near = get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""
