"""A tiny encoder beside the real embedded LLM: where compression pays follows from both times."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


def test_a_compressor_pays_only_below_the_speed_at_which_it_breaks_even(tmp_path: Path) -> None:
    tokens = {way: {"own": {"mean": 800.0}, "new": {"mean": 90.0}} for way in ("guided", "llm", "paper")}
    tokens["llm_no_attention"] = {"own": {"mean": 900.0}, "new": {"mean": 110.0}}
    counted = tmp_path / "tokens.json"
    counted.write_text(json.dumps({"tokens": tokens}))
    options = ("--tokens", str(counted), "--encoders", "tiny", "--repeats", "1")
    found = figures("lab.benchmarks.compressors", *options, out=tmp_path / "compressors.json")
    (tiny,) = found["compressors"].values()
    even = tiny["pays_below_tokens_per_s"]
    for speed, ratio in tiny["spent_to_saved_at_speed_reckoned"].items():
        assert (ratio > 1.0) == (float(speed) > even)
    read = found["seconds_to_read_reckoned"]
    assert read["paper, whole"] == pytest.approx(800 / found["embedded_prefill_tokens_per_s"])
    assert found["attention"]["tokens_saved"] == 20.0
