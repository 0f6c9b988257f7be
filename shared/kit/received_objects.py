"""A limit on the names of a JSON object: an error for each of very many names would block the event loop."""

from typing import Any

from pydantic import ValidationInfo

# More than the fields of any model, so that a few misspelt names still get an error each.
MOST_NAMES = 128


def few_names(given: Any) -> Any:
    """Pass an object on before its validation: for pydantic's ``model_validator(mode="before")``.

    Raises:
        ValueError: the object has more than 128 names.
    """
    if isinstance(given, dict) and len(given) > MOST_NAMES:
        raise ValueError(f"too many fields: {len(given)}, at most {MOST_NAMES}")
    return given


def plain(given: Any, info: ValidationInfo) -> Any:
    """Turn numpy's arrays and numbers in an object into Python's, so that a strict model takes them.

    For pydantic's ``model_validator(mode="before")``. Anything else, JSON above all, passes as it is.
    """
    if info.mode == "json" or not isinstance(given, dict):
        return given
    return {name: _plain(value) for name, value in given.items()} if any(map(_numeric, given.values())) else given


def _numeric(value: Any) -> bool:
    """Whether it is a numpy value, or a list whose first number is one of numpy's."""
    if isinstance(value, list | tuple):
        return hasattr(next((one for one in value if one is not None), None), "tolist")
    return hasattr(value, "tolist")


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple) and _numeric(value):
        return [one.tolist() if hasattr(one, "tolist") else one for one in value]
    return value.tolist() if hasattr(value, "tolist") else value
