"""`decisions.jsonl`: whole lines after any interruption."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulator.records.decision import Decision
from simulator.records.mission_logs import DecisionLog, read_decisions


def decision(**changes: object) -> Decision:
    base = {"step": 0, "uav_id": 0, "position": (1.0, 2.0), "sensor_id": 0, "velocity": 3, "source": "onboard"}
    return Decision.model_validate({**base, **changes})


def test_a_torn_last_line_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "decisions.jsonl"
    whole = [decision(step=0), decision(step=1)]
    with DecisionLog(path) as log:
        for one in whole:
            log.append(one)
    full = path.read_bytes()
    for torn in (full + b'{"step": 2, "uav', full + b'{"step": 2, "reason": "\xc3', full + b"\n"):
        path.write_bytes(torn)
        assert read_decisions(path) == whole


def test_a_broken_line_elsewhere_is_named(tmp_path: Path) -> None:
    path = tmp_path / "decisions.jsonl"
    path.write_text("{}\n" + decision().model_dump_json() + "\n", encoding="utf-8")
    with pytest.raises(ValueError, match="line 1"):
        read_decisions(path)


def test_each_line_is_on_disk_at_once(tmp_path: Path) -> None:
    with DecisionLog(tmp_path / "d.jsonl") as log:
        log.append(decision())
        assert len(read_decisions(tmp_path / "d.jsonl")) == 1


def test_an_interrupt_in_the_middle_of_a_step_leaves_whole_steps(tmp_path: Path) -> None:
    with DecisionLog(tmp_path / "d.jsonl") as log:
        for step in range(3):
            log.append(decision(step=step))
        log.rewrite([decision(step=0)])
        log.append(decision(step=1))
    assert [d.step for d in read_decisions(tmp_path / "d.jsonl")] == [0, 1]
