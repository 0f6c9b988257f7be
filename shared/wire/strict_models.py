"""The bases of the wire's models, and a check of texts."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from shared.kit.received_objects import few_names, plain


class Wire(BaseModel):
    """Strict models: no type coercion, no NaN or infinity. An answer may have further fields of a later version."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, frozen=True)


class Received(Wire):
    """A request's model: no unknown fields, and far too many of them give one error, not one for each.

    In Python, numpy arrays and numbers are accepted too.
    """

    model_config = ConfigDict(extra="forbid")

    # The last one runs first.
    _plain = model_validator(mode="before")(plain)
    _few_names = model_validator(mode="before")(few_names)


# Spaces that are typed in other languages, or pasted.
_SPACES = str.maketrans(dict.fromkeys("\u00a0\u202f\u3000", " "))


def one_paragraph(text: str) -> str:
    """The text; raises ``ValueError`` for a blank one, or one with line breaks or control characters."""
    text = text.translate(_SPACES)
    if not text.isprintable() or not text.strip():
        raise ValueError("must be one paragraph of printable characters, without line breaks or control characters")
    return text


def omitted(description: str, **bounds: Any) -> Any:
    """A field that is left out where it is None: an older client refuses fields that it does not know."""
    return Field(None, exclude_if=lambda value: value is None, description=description, **bounds)
