"""The modules' start: recorded by exploring UAVs, trained, shipped, and better than none."""

from pathlib import Path

import pytest

from service.checkpoint import initial_modules
from service.pretrain import Example, recall, replay
from shared.rollouts import Header, read_rollouts
from shared.scenario import SCENARIOS
from simulator.explore import explore
from tests.e2e.processes import run

PAPER = SCENARIOS["paper"]
# Far past the training worlds that `aicvds explore` records by default.
HELD_OUT = range(50_000, 50_006)


def held_out() -> list[Example]:
    header = Header(scenario=PAPER, missions=len(HELD_OUT), behaviour="test")
    steps = (step for mission in HELD_OUT for step in explore(PAPER, mission))
    return [example for mission in replay(header, steps, horizon=1, discount=1.0) for example in mission]


@pytest.mark.parametrize(("k", "least"), [(5, 0.85), (3, 0.75)])
def test_the_shipped_checkpoint_keeps_the_sensor_that_matters(k: int, least: float) -> None:
    examples = held_out()
    shipped = recall(initial_modules("pretrained", 15, seed=0), examples, k)
    random = recall(initial_modules("random", 15, seed=0), examples, k)
    assert shipped >= least
    assert shipped > random + 0.1


def test_a_scenario_with_a_lower_speed_limit_takes_the_levels_that_it_has() -> None:
    assert initial_modules("pretrained", 8, seed=0).velocity.out.weight.shape[0] == 8


def test_explore_and_pretrain_end_to_end(tmp_path: Path) -> None:
    recorded, checkpoint = tmp_path / "r.jsonl.gz", tmp_path / "c" / "own.pt"
    assert run("explore", "--out", str(recorded), "--missions", "4").returncode == 0
    header, steps = read_rollouts(recorded)
    assert (header.missions, len(list(steps))) == (4, 360)
    trained = run("pretrain", str(recorded), "--out", str(checkpoint), "--epochs", "1")
    assert trained.returncode == 0, trained.stderr
    assert "held-out loss" in trained.stdout
    assert checkpoint.stat().st_size > 1000


@pytest.mark.parametrize("content", [b"", b"not gzip"])
def test_a_broken_file_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "r.gz").write_bytes(content)
    ended = run("pretrain", str(tmp_path / "r.gz"), "--out", str(tmp_path / "c.pt"))
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr
    assert "r.gz" in ended.stderr or "gzip" in ended.stderr
