"""Short flights are decision by decision what commit 601e8f2 flew, on board and over a real edge without an LLM.

EOF and WQCS are newer, and so are the names of `longest_queue` and `queue_and_channel` in the decisions' reasons.
Mode `value` flies by the shipped weights: its flights are those of the weights trained on nine scenarios.
Modes `policy` and `guided` fly by simulated annealing, which plans otherwise than CP-SAT did then.
"""

import json
from pathlib import Path

import pytest

from tests.benchmarks.running import figures

pytestmark = pytest.mark.long


RECORDED = Path(__file__).with_name("flights.json")
SHORT = (
    r"^(paper|pipeline) (longest_queue|queue_and_channel|eof|wqcs|value full)"
    r"|^paper (value|policy|guided) (full|delta|pruned)"
)


def test_seeds_fly_as_they_flew(tmp_path: Path) -> None:
    found = figures(
        "benchmarks.flight_hashes", "--seeds", "0", "1", "--steps", "3", "--only", SHORT, out=tmp_path / "flights.json"
    )
    assert found == json.loads(RECORDED.read_text())
