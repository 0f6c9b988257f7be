"""The harness: rounds in turn, goals, and the file of figures."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.harness import Goal, Options, Report, environment, in_turn, run, running, shown
from tests.support.edge_stub import free_port


@dataclass(frozen=True)
class Counting(Options):
    """Counts."""

    rounds: int = 2
    """Rounds."""


def counted(args: Counting) -> Report:
    goals = [Goal("rounds", [2.0, 1.0, 3.0], most=1.5), Goal("rounds", args.rounds, least=2)]
    return Report({"rounds": args.rounds}, {"Rounds": {"all": {"number": args.rounds}}, "None": {}}, goals)


def test_figures_and_goals_are_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["counting.py", "--rounds", "3"])
    assert not run(Counting, counted)
    found = json.loads((tmp_path / "runs" / "counting.json").read_text())
    assert found["rounds"] == 3 and found["machine"]["cores"] >= 1
    assert [goal["met"] for goal in found["goals"]] == [False, True]
    said = capsys.readouterr().out
    assert "at most 1.5" in said and "missed" in said and "2 [1, 3]" in said


def test_every_round_has_every_variant_and_a_warm_up_does_not_count() -> None:
    order: list[str] = []

    def variant(name: str) -> Callable[[int], int]:
        def measured(number: int) -> int:
            order.append(f"{name}{number}")
            return number

        return measured

    variants = {name: variant(name) for name in "ab"}
    assert in_turn(variants, 2, warm_up=1, alternate=True) == {"a": [0, 1], "b": [0, 1]}
    assert order == ["b-1", "a-1", "a0", "b0", "b1", "a1"]


def test_numbers_are_short() -> None:
    assert [shown(cell) for cell in ("text", 0.1234, 1068.4, [0.5, 0.25, 100.0])] == [
        "text",
        "0.123",
        "1,068",
        "0.5 [0.25, 100]",
    ]


def test_an_edge_inherits_no_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AICVDS_MODE", "value")
    monkeypatch.setenv("AICVDS_CACHE_DIR", "cache")
    found = environment({"PLANNER_MS": 5})
    assert {name: found[name] for name in found if name.startswith("AICVDS_")} == {
        "AICVDS_CACHE_DIR": "cache",
        "AICVDS_PLANNER_MS": "5",
    }


def test_a_server_that_ends_is_an_error_with_its_output() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    with (
        pytest.raises(SystemExit, match="no such thing"),
        running([sys.executable, "-c", "raise SystemExit('no such thing')"], url, "/"),
    ):
        pass
