"""`python -m lab explore`: the alternation of teachers, the workers, and errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.commands.explore import main, teacher_of
from lab.exploration.rollouts import RolloutStep, read_rollouts
from lab.exploration.teachers import TEACHERS, TeacherName
from shared.world.scenario import SCENARIOS
from tests.support.edge_stub import stub_edge

SHORT = SCENARIOS["paper"].model_copy(update={"steps": 12})
NAMES: list[TeacherName] = ["planner", "clairvoyant"]


def test_both_teachers_alternate() -> None:
    assert [teacher_of("both", mission) for mission in range(4)] == ["planner", "clairvoyant"] * 2
    assert teacher_of("clairvoyant", 0) == "clairvoyant"
    assert set(NAMES) == set(TEACHERS)


@pytest.mark.long
def test_the_number_of_workers_does_not_change_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENARIOS, "paper", SHORT)
    written = []
    for workers in ("1", "2"):
        out = tmp_path / f"{workers}.gz"
        assert main(["--out", str(out), "--missions", "2", "--untaught", "1", "--workers", workers]) == 0
        written.append(list(read_rollouts(out)[1]))
    assert written[0] == written[1]
    assert len(written[0]) == 3 * 36
    taught = [{step.reference.teacher for step in written[0][m * 36 :][:36] if step.reference} for m in range(3)]
    assert taught == [{"planner"}, {"clairvoyant"}, set()]


def test_a_second_file_goes_on_with_further_worlds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENARIOS, "paper", SHORT)
    found: dict[str, list[RolloutStep]] = {}
    for name, first, worlds in (("both", 0, 2), ("second", 1, 1)):
        out = tmp_path / f"{name}.gz"
        options = ["--missions", "0", "--untaught", str(worlds), "--first", str(first)]
        assert main(["--out", str(out), *options]) == 0
        found[name] = list(read_rollouts(out)[1])
    assert found["second"] == found["both"][36:]


def test_a_scenario_is_changed_by_its_fields(tmp_path: Path) -> None:
    out = tmp_path / "changed.gz"
    changes = ["--sensors", "4", "--uavs", "2", "--set", "steps=3", "--set", "wind_mps=2"]
    assert main(["--out", str(out), "--missions", "0", "--untaught", "1", *changes]) == 0
    header, steps = read_rollouts(out)
    scenario = header.scenario
    assert (scenario.sensors, scenario.uavs, scenario.steps, scenario.wind_mps) == (4, 2, 3, 2.0)
    assert scenario.name.startswith("paper_changed_") and len(list(steps)) == 3 * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--missions", "-1"], "--missions -1 is less than 0"),
        (["--missions", "0", "--untaught", "0"], "there is nothing to fly"),
        (["--first", "-1"], "--first -1 is less than 0"),
        (["--workers", "0"], "--workers 0 is not between 1 and 64"),
        (["--scenario", "moon"], "unknown scenario 'moon'"),
        (["--edge", "http://127.0.0.1:1"], "no edge is ready at http://127.0.0.1:1"),
        (["--set", "winds=4"], "--set winds=4: a scenario has no field 'winds'"),
        (["--edge", "127.0.0.1"], "'127.0.0.1' is not an edge's URL"),
    ],
)
def test_bad_use_is_one_clear_line(
    options: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lab.commands.explore.READY_S", 0.0)
    assert main(["--out", str(tmp_path / "r.gz"), *options]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1


def test_an_edge_that_fails_on_the_way_leaves_no_file_that_looks_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.gz"
    with stub_edge() as stub:
        stub.script, stub.otherwise = ["ok"] * 5, "invalid"
        options = ["--out", str(out), "--missions", "0", "--untaught", "1", "--edge", stub.url]
        assert main(options) == 2
    assert "python -m lab explore: no decision" in capsys.readouterr().err
    assert not out.exists()
