"""The embedded model and its adapter in Hugging Face's format: ``python -m`` this module ``FOLDER``.

``transformers serve`` 5.23 ends with a TypeError at a GGUF file, because its configuration names no architecture.
"""

from __future__ import annotations

import copy
import sys
from pathlib import Path

from service.config.settings import SHIPPED_ADAPTER, Settings
from service.llm.model_file import embedded_model


def write(folder: Path) -> None:
    """Write ``merged``, ``bare`` and ``adapter``: weights in 32 bits and all around them, 1.1 GB."""
    from lab.distilling.student import Student

    student = Student(embedded_model(Settings()), static="", rank=8, device="cpu", begin=SHIPPED_ADAPTER)
    student.write_peft(folder / "adapter")
    # In 32 bits before the sum: 16 bits would round the adapter away.
    bare = copy.deepcopy(student.model.float()).unload()
    for name, model in {"bare": bare, "merged": student.model.merge_and_unload()}.items():
        model.config.use_cache = True
        model.save_pretrained(folder / name)
        student.tokenizer.save_pretrained(folder / name)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
