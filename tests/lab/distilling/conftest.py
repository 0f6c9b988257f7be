"""The embedded model in torch, read from its file once a process."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from lab.distilling.examples import PromptExample, View, missions_of, prompt_examples
from lab.exploration.exploration import explore
from lab.exploration.rollouts import Header, read_rollouts, write_rollouts
from shared.world.scenario import SCENARIOS

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 5})


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


@pytest.fixture(scope="module")
def rollouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("rollouts") / "paper.jsonl.gz"
    steps = [step for mission in range(60_000, 60_003) for step in explore(SHORT, mission, "planner")]
    write_rollouts(file, Header(scenario=SHORT, missions=3, behaviour="test"), steps)
    return file


def examples_in(view: View, rollouts: Path) -> list[list[PromptExample]]:
    header, steps = read_rollouts(rollouts)
    return [prompt_examples(header, mission, view) for mission in missions_of(steps)]
