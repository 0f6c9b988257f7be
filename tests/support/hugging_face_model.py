"""The embedded model with its adapter merged, in Hugging Face's format: ``python -m`` this module ``FOLDER``.

``transformers serve`` 5.23 ends with a TypeError at a GGUF file, because its configuration names no architecture.
"""

from __future__ import annotations

import sys
from pathlib import Path

from service.config.settings import SHIPPED_ADAPTER, Settings
from service.llm.model_file import embedded_model


def write(folder: Path) -> None:
    """Write weights in 32 bits, configuration, tokenizer and chat template: 540 MB."""
    from lab.distilling.student import Student

    student = Student(embedded_model(Settings()), static="", rank=8, device="cpu", begin=SHIPPED_ADAPTER)
    # In 32 bits before the sum: 16 bits would round the adapter away.
    merged = student.model.float().merge_and_unload()
    merged.config.use_cache = True
    merged.save_pretrained(folder)
    student.tokenizer.save_pretrained(folder)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
