"""The study of the links' probabilities."""

import csv
from pathlib import Path

import pytest

from lab.benchmarks.link_calibration import Calibration, main

pytestmark = pytest.mark.long


def test_links_of_higher_probability_hold_more_often(tmp_path: Path) -> None:
    out = tmp_path / "links.csv"
    assert main(Calibration(worlds=2, out=out)) == 0
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 20 and {row["seed"] for row in rows} == {"500", "501"}
    low, high = (
        sum(int(row["hold"]) for row in chosen) / sum(int(row["links"]) for row in chosen)
        for chosen in ([row for row in rows if row["from"] == at] for at in ("0.1", "0.9"))
    )
    assert low < 0.3 and high > 0.9
