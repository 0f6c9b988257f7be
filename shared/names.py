"""A limit on the names of a JSON object: an error for each of very many names would block the event loop."""

from __future__ import annotations

from typing import Any

# More than any model has fields, so that a few misspelt names still get an error each.
MOST_NAMES = 128


def few_names(given: Any) -> Any:
    """Pass an object on before its validation: for pydantic's ``model_validator(mode="before")``.

    Raises:
        ValueError: the object has more than 128 names.
    """
    if isinstance(given, dict) and len(given) > MOST_NAMES:
        raise ValueError(f"an object of {len(given)} names, and {MOST_NAMES} are more than there are")
    return given
