"""The inputs of training on a machine without this project's packages: the LLM's tensors, and the tokens of prompts.

    python -m lab.adapter.base --gguf SmolLM2-135M-Instruct.Q4_1.gguf --out runs/base

It writes base0.npz and base1.npz, vocabulary.npz with the embeddings of all tokens, and tokens.json. For a file of
type Q8_0 the first three have 53, 53 and 28 MB.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gguf
import numpy as np
from transformers import AutoTokenizer

from lab.adapter.batches import LETTERS
from service.prompting.compact_prompt import SIGNS, STATIC

_MARK = "0"


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gguf", required=True, type=Path)
    parser.add_argument("--out", required=True, type=Path)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    tokenizer: Any = AutoTokenizer.from_pretrained(args.gguf.parent, gguf_file=args.gguf.name)
    messages = [{"role": "system", "content": STATIC}, {"role": "user", "content": _MARK}]
    whole = tokenizer.apply_chat_template(messages, tokenize=False, add_generation_prompt=True)
    head, _, tail = whole.rpartition(_MARK)
    before, after = tokenizer([head, tail], add_special_tokens=False).input_ids
    characters = {}
    for character in f"0123456789{LETTERS}UXY{SIGNS}":
        _, characters[character], _ = tokenizer(f"5{character}5", add_special_tokens=False).input_ids
    used = sorted({*characters.values(), *before, *after})
    place = {token: number for number, token in enumerate(used)}
    parts: tuple[dict[str, np.ndarray], ...] = ({}, {})
    kinds = {}
    for tensor in gguf.GGUFReader(args.gguf).tensors:
        data = tensor.data
        if tensor.name == "token_embd.weight":
            np.savez_compressed(args.out / "vocabulary.npz", all=tensor.data)
            data = tensor.data[used]
        smaller = min(parts, key=lambda part: sum(values.nbytes for values in part.values()))
        smaller[tensor.name] = np.ascontiguousarray(data)
        kinds[tensor.name] = tensor.tensor_type.name
    for number, part in enumerate(parts):
        np.savez_compressed(args.out / f"base{number}.npz", **part)
    known = {
        "char": {character: place[token] for character, token in characters.items()},
        "before": [place[token] for token in before],
        "after": [place[token] for token in after],
        "signs": SIGNS,
        "kinds": kinds,
    }
    (args.out / "tokens.json").write_text(json.dumps(known), encoding="utf-8")


if __name__ == "__main__":
    main()
