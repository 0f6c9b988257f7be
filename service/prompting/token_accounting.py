"""Token accounting: each block's length, counted offline, the prompt's length without pruning, and its price."""

from functools import lru_cache
from pathlib import Path

from service.config.settings import Settings
from service.llm.answers import Completion
from service.prompting.prompt import Prompt
from service.prompting.tokenizer import ENCODING, encoding
from shared.wire.schemas import Tokens

_SAME_DIGITS = str.maketrans(dict.fromkeys("0123456789", "5"))


class TokenCounter:
    """Counts tokens with tiktoken's ``o200k_base`` (GPT-4o-mini's), from a vocabulary on disk."""

    name = ENCODING

    def __init__(self, cache_dir: Path) -> None:
        self._encoding = encoding(cache_dir)
        # The static block and most lines recur with every decision. A new line differs from earlier ones in its digits
        # alone, and its tokens depend on the number of these: every number of up to three digits is one token.
        self.count_repeated, alike = (lru_cache(maxsize=most)(self.count) for most in (256, 4096))
        self.count_line = lru_cache(maxsize=4096)(lambda line: alike(line.translate(_SAME_DIGITS)))

    def count(self, text: str) -> int:
        """Tokens of a text; special tokens are counted as plain text."""
        return len(self._encoding.encode_ordinary(text))

    def account(self, prompt: Prompt) -> Tokens:
        """The length of each block of a prompt, and the prompt's length without pruning."""
        static = self.count_repeated(prompt.static)
        experiences = sum(map(self.count_line, prompt.experiences.splitlines(keepends=True)))
        rows = prompt.uncompressed.tokens_by_row(self.count_repeated)
        head = self.count_line(prompt.uncompressed.head)
        state = self.count(prompt.state) if prompt.kept is None else head + int(rows[[*prompt.kept]].sum())
        state_uncompressed = head + int(rows.sum())
        return Tokens(
            tokenizer=self.name,
            static=static,
            experiences=experiences,
            state=state,
            state_uncompressed=state_uncompressed,
            prompt=static + experiences + state,
            uncompressed=static + experiences + state_uncompressed,
            saved=state_uncompressed - state,
        )


def with_usage(tokens: Tokens, completion: Completion | None, settings: Settings) -> Tokens:
    """The account, with the server's own counts for the call and the call's price."""
    if completion is None or completion.prompt_tokens is None:
        return tokens
    cached = completion.cached_tokens or 0
    usage = {
        "server_prompt": completion.prompt_tokens,
        "cached": completion.cached_tokens,
        "completion": completion.completion_tokens,
        "cost_usd": price_usd(settings, completion.prompt_tokens, cached, completion.completion_tokens or 0),
    }
    return tokens.model_copy(update=usage)


def price_usd(settings: Settings, prompt: int, cached: int, completion: int) -> float:
    """The price of one call in US dollars: fresh and cached prompt tokens, and completion tokens."""
    fresh = (prompt - cached) * settings.price_input
    return (fresh + cached * settings.price_cached + completion * settings.price_output) / 1e6
