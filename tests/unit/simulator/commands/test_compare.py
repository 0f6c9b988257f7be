"""`aicvds compare`: the missions' own numbers, side by side."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulator.commands import compare, simulate
from simulator.records.summary import Summary


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three steps of EOF and WQCS."""
    folder = tmp_path_factory.mktemp("runs")
    for policy in ("eof", "wqcs"):
        arguments = ["--policy", policy, "--steps", "3", "--no-bound", "--out", str(folder / policy)]
        assert simulate.main(arguments) == 0
    return [folder / "eof", folder / "wqcs"]


def test_the_numbers_and_the_figures_stand_side_by_side(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "new" / "page.html"
    assert compare.main([*map(str, runs), "--out", str(page)]) == 0
    printed, html = capsys.readouterr().out, page.read_text(encoding="utf-8")
    summaries = [Summary.model_validate_json((run / "summary.json").read_bytes()) for run in runs]
    for summary in summaries:
        lost = next(iter(summary.lost_packets.values()))
        assert str(lost) in printed and f"<td>{lost}</td>" in html
    assert html.count('src="data:image/svg+xml;base64,') == 4
    assert "round trip" not in printed
    assert "One world is an example" in printed


def test_different_worlds_are_told_apart(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--policy", "eof", "--steps", "2", "--seed", "1", "--no-bound", "--out", str(tmp_path / "eof")]
    assert simulate.main(arguments) == 0
    assert compare.main([str(runs[0]), str(tmp_path / "eof"), "--out", str(tmp_path / "page.html")]) == 0
    assert "their losses cannot be compared" in capsys.readouterr().out


def test_bad_use_is_one_line_and_code_2(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "summary.json").write_text("{}")
    for arguments, said in (
        ([str(runs[0])], "name two or more"),
        ([str(runs[0]), str(tmp_path / "none")], "name the --out folder of a mission"),
        ([str(runs[0]), str(tmp_path)], "this is no mission's summary"),
    ):
        assert compare.main(arguments) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


def test_a_comparison_replaces_only_a_comparison(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, record = tmp_path / "page.html", tmp_path / "summary.json"
    record.write_bytes((runs[0] / "summary.json").read_bytes())
    for out, code in ((page, 0), (page, 0), (record, 2)):
        assert compare.main([*map(str, runs), "--out", str(out)]) == code
    assert "is no comparison: choose another file" in capsys.readouterr().err
    assert record.read_bytes() == (runs[0] / "summary.json").read_bytes()
