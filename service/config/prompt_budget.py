"""An upper bound of a prompt's tokens, before the prompt exists."""

from shared.wire.schemas import Features, PromptFormat

# Upper bounds in tokens of the embedded model, which has one for each digit: of the static block, and of a row or an
# experience in each format.
_STATIC_TOKENS = 800
_ROW_TOKENS = {"csv": 44, "compact": 12}
# Of the two further columns of feature preset `reach`.
_REACH_TOKENS = 16


def prompt_tokens(
    row_format: PromptFormat, rows: int, experiences: int, features: Features = "paper", demonstrations: str = ""
) -> int:
    """Upper bound of a prompt's length in the embedded model's tokens.

    Args:
        demonstrations: their text, all ASCII: a tokenizer makes at most one token of a character.
    """
    row = _ROW_TOKENS[row_format] + (_REACH_TOKENS if features == "reach" else 0)
    return _STATIC_TOKENS + row * (rows + experiences) + len(demonstrations)
