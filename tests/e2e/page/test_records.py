"""Page and report say what the records say: one mission of each mode and preset, every number compared."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from shared.world.scenario import SCENARIOS
from tests.e2e.page.conftest import Open
from tests.support.processes import run, serving_edge

pytestmark = [pytest.mark.needs("chromium"), pytest.mark.long]

STEPS = 6
MODES = ("value", "policy", "guided", "llm")
# Every mode on `paper`, and every other preset in one mode.
OTHERS = sorted(set(SCENARIOS) - {"paper"})
FLIGHTS = [("paper", mode) for mode in MODES] + [(name, MODES[n % len(MODES)]) for n, name in enumerate(OTHERS)]
WORDS = {"value": "learned values", "policy": "LLM-free policy", "guided": "guided", "llm": "LLM"}


@pytest.fixture(scope="module")
def edge() -> Iterator[str]:
    """One whose LLM is out of reach: modes guided and llm fall back, and must say so."""
    with serving_edge(AICVDS_MODE="llm", AICVDS_LLM_URL="http://127.0.0.1:1/v1", AICVDS_LLM_MODEL="none") as (url, _):
        yield url


@dataclass
class Records:
    """What a flight left."""

    summary: dict[str, Any]
    decisions: list[dict[str, Any]]
    report: str

    @classmethod
    def of(cls, out: Path) -> Records:
        lines = (out / "decisions.jsonl").read_text(encoding="utf-8").splitlines()
        report = re.sub(r"<svg.*?</svg>", "", (out / "report.html").read_text(encoding="utf-8"), flags=re.DOTALL)
        return cls(json.loads((out / "summary.json").read_bytes()), [json.loads(line) for line in lines], report)


def flown(edge: str, out: Path, scenario: str, mode: str) -> Records:
    world = ("--scenario", scenario, "--steps", str(STEPS), "--mode", mode, "--no-bound")
    ended = run("simulate", "--edge", edge, *world, "--deadline-ms", "60000", "--out", str(out))
    assert ended.returncode == 0, ended.stderr
    return Records.of(out)


def tiles(page: Page) -> dict[str, tuple[str, str]]:
    """The page's tiles: value and detail by name."""
    names, values, details = (
        page.locator(f".numbers {part}").all_text_contents() for part in ("dt", ".value", ".detail")
    )
    return {name: (value, detail) for name, value, detail in zip(names, values, details, strict=True)}


@pytest.mark.parametrize(("scenario", "mode"), FLIGHTS)
def test_nothing_contradicts_the_records(visit: Open, edge: str, tmp_path: Path, scenario: str, mode: str) -> None:
    records = flown(edge, tmp_path / "run", scenario, mode)
    summary, decisions = records.summary, records.decisions
    sources = Counter(d["source"] for d in decisions)
    failed = sum(d["failed"] for d in decisions)
    check_report(records, sources, failed)
    page = visit(f"{edge}/?mission={summary['mission_id']}")
    from_edge = [d for d in decisions if d["source"] != "onboard"]
    expect(page.locator("#mission")).to_have_attribute("data-made", str(len(from_edge)))
    expect(page.locator("#badge")).to_have_text("Ended")
    found = tiles(page)
    assert found["Decisions"][0] == str(len(from_edge))
    for source, count in sources.items():
        if source != "onboard":
            assert f"{count} {WORDS[source]}" in found["Decisions"][1]
    assert found["Failed"][0] == str(failed)
    reported = re.search(r"of (\d+) reported transmissions; cost ([\d.,]+)", found["Failed"][1])
    assert reported is not None and int(reported[1]) == len(from_edge)
    assert float(reported[2].replace(",", "")) == pytest.approx(sum(d["cost"] for d in from_edge), abs=0.051)
    assert ("Tokens saved" in found) == (mode in ("guided", "llm"))
    for card in page.locator("#feed .by").all_inner_texts():
        assert any(card.startswith(WORDS[source]) for source in sources if source != "onboard")
    expect(page.locator("#about")).to_contain_text(f"mode {mode}")


def check_report(records: Records, sources: Counter[str], failed: int) -> None:
    summary, report = records.summary, records.report
    for policy, lost in summary["lost_packets"].items():
        label = {"aic_vds": r"AIC-VDS: [^<]*", "eof": "EOF", "wqcs": "WQCS"}[policy]
        row = rf"<td>{label}</td><td>{lost:,}</td><td>{summary['loss_events'][policy]:,}</td>"
        assert re.search(row, report), row
    assert f"lost {summary['lost_packets']['aic_vds']:,} packet" in report
    assert f"<td>failed transmissions</td><td>{failed}</td>" in report
    for source, count in sources.items():
        assert f"<td>{source}</td><td>{count}</td>" in report
    costly = [d for d in records.decisions if d["cost"] > 0]
    assert report.count('<td data-label="cost">') == min(len(costly), 15)
    # This LLM has no part in any decision, and the report gives it none.
    if summary["mode"] in ("guided", "llm"):
        assert "The LLM took 0 of" in report or "The LLM took part in none of" in report
    assert "to lose more" not in report
