"""The embedded model in torch, read from its file once a process."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import pytest


@pytest.fixture(scope="package")
def loaded_once() -> Iterator[None]:
    """A student has a copy of the model that the first one read: to read the GGUF file takes many seconds."""
    from transformers import AutoModelForCausalLM, AutoTokenizer

    with pytest.MonkeyPatch.context() as patch:
        for loader in (AutoModelForCausalLM, AutoTokenizer):
            patch.setattr(loader, "from_pretrained", _remembered(loader.from_pretrained))
        yield


def _remembered(load: Any) -> Any:
    read: dict[str, Any] = {}

    def loaded(*args: Any, **options: Any) -> Any:
        key = repr((args, sorted(options.items(), key=lambda item: item[0])))
        if key not in read:
            read[key] = load(*args, **options)
        return deepcopy(read[key])

    return loaded
