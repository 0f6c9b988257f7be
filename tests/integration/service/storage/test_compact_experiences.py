"""The experiences of a mission with the compact prompt: in flight, and after a restart."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from tests.support.running import serving
from tests.support.stored_missions import copy_of, fly, running
from tests.support.stub_llm import StubLlm, wait_for

Report = Callable[..., dict[str, Any]]
EIGHT = {"prompt": {"experiences": 8}}
ADAPTED = {"mode": "llm", "llm_adapter": "served", "planner": "off"}


def test_a_restart_keeps_the_block_and_the_prompts_go_on_with_it(tmp_path: Path, report: Report) -> None:
    model = StubLlm("A")
    with serving(model.app) as url:
        settings = {**ADAPTED, "llm_url": f"{url}/v1"}
        with running(tmp_path / "m.db", **settings) as (client, engine):
            wait_for(client, "ready")
            assert client.put("/missions/test", json=EIGHT).status_code == 200
            pending = fly(client, report, range(4))
            block = list(engine.missions.loaded[0].experiences.block)
            copy_of(tmp_path / "m.db", tmp_path / "copy.db")
        assert 4 <= len(block) <= 8
        assert all(re.fullmatch(r"\d\D\d[XY]", line) for line in block)
        with running(tmp_path / "copy.db", **settings) as (client, engine):
            wait_for(client, "ready")
            assert client.get("/missions/test").status_code == 200
            assert engine.missions.loaded[0].experiences.block == block
            fly(client, report, range(4, 5), pending)
            asked = [body["messages"][-1]["content"] for body in model.bodies[-3:]]
            assert all(re.match(r"(?:\d\D\d[XY]){4,8}\d{6}U", text) for text in asked), asked


def test_between_compactions_a_prompt_begins_with_the_one_before(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db", **ADAPTED, llm_url="http://127.0.0.1:9/v1") as (client, engine):
        assert client.put("/missions/test", json=EIGHT).status_code == 200
        pending: dict[int, Any] = {}
        seen = [("", 0)]
        for step in range(12):
            pending = fly(client, report, range(step, step + 1), pending)
            memory = engine.missions.loaded[0].experiences
            seen.append(("".join(memory.block), memory.compactions))
    assert seen[-1][1] >= 3
    same = [(one, other) for (one, before), (other, after) in pairwise(seen) if before == after]
    assert len(same) >= 4
    assert all(later.startswith(earlier) for earlier, later in same)
