"""Objects of more names than any of ours has: refused as a whole, because an error for each stops an event loop."""

from __future__ import annotations

from typing import Any

# Past the fields of every model; a handful of misspelt ones are each told.
MOST_NAMES = 128


def few_names(told: Any) -> Any:
    """What was told, before it is looked at: for pydantic's ``model_validator(mode="before")``.

    Raises:
        ValueError: an object of more than 128 names.
    """
    if isinstance(told, dict) and len(told) > MOST_NAMES:
        raise ValueError(f"an object of {len(told)} names, and {MOST_NAMES} are more than there are")
    return told
