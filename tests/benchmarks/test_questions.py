"""The five tables of the benchmarks, as they are written into their page."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.harness import Rows
from benchmarks.questions import write
from lab.experiments.execution import commit
from tests.support.places import ROOT

pytestmark = pytest.mark.long

TABLES: dict[str, Rows] = {
    "1. What is asked": {"a row": {"ms": 1.5, "ratio": [0.5, 0.4, 0.61]}, "another": {"ratio": 1234.0}}
}


def test_the_tables_replace_those_of_the_page_and_nothing_else(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("Before.\n\n<!-- five tables -->\nold\n<!-- end of the five tables -->\n\nAfter.\n")
    for _ in range(2):
        write(page, TABLES)
        text = page.read_text()
        assert text.startswith(
            "Before.\n\n<!-- five tables -->\n\n### 1. What is asked\n\n| | ms | ratio |\n|---|---|---|\n"
        )
        assert "| a row | 1.5 | 0.5 [0.4, 0.61] |\n| another |  | 1,234 |\n" in text
        assert text.endswith("<!-- end of the five tables -->\n\nAfter.\n") and "old" not in text
        numbers = (tmp_path / "data" / "five-tables.csv").read_text().splitlines()
        assert numbers[1:3] == [
            f"1. What is asked,a row,ms,1.5,,,{commit() or ''}",
            f"1. What is asked,a row,ratio,0.5,0.4,0.61,{commit() or ''}",
        ]


def test_a_page_without_a_place_for_the_tables_is_refused(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("Nothing.\n")
    with pytest.raises(ValueError, match="five tables"):
        write(page, TABLES)
    assert page.read_text() == "Nothing.\n"


def test_the_page_of_the_benchmarks_has_a_place(tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    page.write_text((ROOT / "docs/results/benchmarks.md").read_text(encoding="utf-8"))
    write(page, TABLES)
    assert "| a row | 1.5" in page.read_text()
