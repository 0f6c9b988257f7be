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
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "must be a JSON object"),
    **dict.fromkeys(("list_type", "tuple_type"), "must be a list"),
    "bool_type": "must be true or false",
    "union_tag_invalid": "is of an unknown type",
    "union_tag_not_found": "has no type",
}
# The words for the patterns of fields.
_PATTERNS = {
    r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$": "1 to 64 letters, digits, `.`, `_` and `-`, with a letter or digit first",
    r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\*?$": "a mission's ID, or the beginning of IDs and `*`",
    r"^[A-Za-z0-9_.-]{1,64}$": "1 to 64 letters, digits, `_`, `.` and `-`",
    r"^[0-9A-Za-z_-]{1,64}$": "1 to 64 letters, digits, `_` and `-`",
    r"^[A-Za-z0-9-]{1,64}$": "1 to 64 letters, digits and `-`",
    r"^[a-z][a-z0-9_]{0,31}$": "1 to 32 lower-case letters, digits and `_`, with a letter first",
    r"^[\x21-\x7e]{1,64}$": "1 to 64 printable ASCII characters without spaces",
    r"^[^/+#@\s]{1,100}$": "1 to 100 characters without spaces and `/ + # @`",
    r"^[0-9A-Fa-f]{16}$": "16 hexadecimal digits",
    r"^[0-9a-f]{32}$": "32 hexadecimal digits in lower case",
    r"^[0-9a-f]{64}$": "64 hexadecimal digits in lower case",
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
    if error["type"] == "string_pattern_mismatch" and error["ctx"]["pattern"] in _PATTERNS:
        text = f"must be {_PATTERNS[error['ctx']['pattern']]}"
    elif error["type"] == "json_invalid":
        text = f"is no JSON: {error['ctx']['error']}"
    for prefix in _PREFIXES:
        text = text.removeprefix(prefix)
    return _SUBJECT.sub("must ", text).replace(" after validation", "")


def suggestion(name: str, known: Collection[str]) -> str:
    """``; did you mean X?`` with the nearest known name; empty where none is near."""
    near = get_close_matches(name, known, n=1, cutoff=0.75)
    return f"; did you mean {near[0]}?" if near else ""
