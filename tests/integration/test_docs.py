"""The documentation builds without a warning, needs nothing from elsewhere, and its Python runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import unicodedata
from collections.abc import Iterable
from pathlib import Path

import pytest
import yaml

from lab.experiments.result import Result
from tests.conftest import Edge
from tests.support.places import ROOT
from tests.support.processes import run_lab_here

# Where a reader is led, not what a page loads.
LINKS = re.compile(r"<a [^>]*>")
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted(DOCS.glob("**/*.md"))]
CODE = "benchmarks|docker|examples|field|lab|service|shared|simulator|tests"
CODE_PATH = re.compile(rf"(?<![\w./-])(?:{CODE})/[\w./-]*")
CODE_NAME = re.compile(rf"`((?:{CODE})/[\w/]+\.py):([\w.]+)`")
COMMIT = re.compile(r"`[0-9a-f]{7,12}`|\bcommit [0-9a-f]{7}")
DAY = re.compile(r"\b20\d\d-\d\d-\d\d\b")
LOADED = re.compile(r'(?:src|href)="((?:https?:)?//[^"]+)"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `make docs` builds."""
    out = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0 and not built.stderr, built.stderr
    return out


def test_every_page_is_built(site: Path) -> None:
    pages = {path.relative_to(DOCS).with_suffix(".html") for path in DOCS.glob("**/*.md")}
    assert pages and all((site / page).exists() for page in pages)
    assert (site / "search" / "search_index.json").stat().st_size > 10_000


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.glob("**/*.html"):
        assert not LOADED.findall(LINKS.sub("", page.read_text(encoding="utf-8"))), page.name


def test_equations_are_drawn(site: Path) -> None:
    method = (site / "reference" / "method.html").read_text(encoding="utf-8")
    asked = (DOCS / "reference" / "method.md").read_text(encoding="utf-8").count("$$") // 2
    assert asked > 5
    assert method.count('<p class="equation"><svg') == asked
    assert "arithmatex" not in method and "merror" not in method


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_path_of_the_code_exists(page: Path) -> None:
    paths = {path.rstrip(".-/") for path in CODE_PATH.findall(page.read_text(encoding="utf-8"))}
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_every_name_in_the_architecture_is_in_its_file() -> None:
    named = CODE_NAME.findall((DOCS / "reference" / "architecture.md").read_text(encoding="utf-8"))
    assert len(named) > 30
    defined = {path: (ROOT / path).read_text(encoding="utf-8") for path, _ in named}
    for path, name in named:
        for part in name.split("."):
            definition = rf"^ *(?:async )?(?:def|class) {part}\b|^{part}\b.* = "
            assert re.search(definition, defined[path], re.MULTILINE), f"{path} defines no {name}"


def test_the_architecture_names_every_room() -> None:
    named = (DOCS / "reference" / "architecture.md").read_text(encoding="utf-8")
    rooms = [
        f"{path.parent.name}/{path.name}/"
        for package in ("field", "lab", "service", "shared", "simulator")
        for path in sorted((ROOT / package).iterdir())
        if path.is_dir() and any(path.glob("*.py"))
    ]
    assert len(rooms) > 30
    assert [room for room in rooms if f"`{room}`" not in named] == []


def test_the_readme_and_the_docs_are_short() -> None:
    assert lines([ROOT / "README.md"]) <= 110
    assert lines(path for path in DOCS.glob("**/*.md") if "results" not in path.parts) <= 1900


@pytest.mark.parametrize("page", sorted(DOCS.glob("decisions/*.md")), ids=lambda page: page.stem)
def test_a_decision_is_a_screen_long(page: Path) -> None:
    assert lines([page]) <= 40
    listed = (DOCS / "decisions" / "index.md").read_text(encoding="utf-8")
    assert page.name == "index.md" or f"]({page.name})" in listed


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_page_has_a_commit_or_a_day(page: Path) -> None:
    # The release guide shows the changelog's form.
    text = page.read_text(encoding="utf-8").replace("## [1.2.3] - 2026-11-30", "")
    # A command makes this page, and its results name the commit that flew them.
    commits = [] if page == DOCS / "results" / "experiments.md" else COMMIT.findall(text)
    assert commits + DAY.findall(text) == []


def test_the_citation_names_the_paper_and_the_software_as_the_docs_do() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited.keys() >= {"cff-version", "message", "title", "authors", "type", "license"}
    paper, page = cited["preferred-citation"], (DOCS / "results" / "paper.md").read_text(encoding="utf-8")
    bibtex = re.search(r"```bibtex\n(.*?)```", page, re.DOTALL)
    assert bibtex
    plain = re.sub(r"\{\\'(\w)\}", lambda accent: unicodedata.normalize("NFC", accent[1] + "\u0301"), bibtex[1])
    assert paper["title"] in plain.replace("{AIC-VDS}", "AIC-VDS")
    names = [f"{author['family-names']}, {author['given-names']}" for author in paper["authors"]]
    assert f"{{{' and '.join(names)}}}" in plain and f"{{{paper['doi']}}}" in plain and f"{{{paper['year']}}}" in plain


def lines(pages: Iterable[Path]) -> int:
    return sum(len(page.read_text(encoding="utf-8").splitlines()) for page in pages)


def blocks(page: str) -> str:
    """A page's Python, as one program."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


def test_the_policy_shown_flies_beside_shipped_ones(tmp_path: Path) -> None:
    policy = tmp_path / "fullest.py"
    policy.write_text(blocks("docs/guides/policy.md"), encoding="utf-8")
    own = f"{policy}:FullestInRange"
    args = ["experiment", "scheduler", "--llm", "none", "--scheme", "eof", "--seeds", "2", "--out", str(tmp_path)]
    assert run_lab_here(*args, "--policy", own).returncode == 0
    result = Result.model_validate_json((tmp_path / "scheduler" / "results.json").read_bytes())
    assert result.seeds_of.get(own, result.seeds) == [0, 1] and result.schemes.keys() == {"eof", own}
    flown = set(tmp_path.glob("flights/*"))
    # A changed policy flies again, the other scheme does not.
    policy.write_text(policy.read_text(encoding="utf-8").replace("min(10,", "min(9,"), encoding="utf-8")
    assert run_lab_here(*args, "--policy", own).returncode == 0
    assert len(set(tmp_path.glob("flights/*")) - flown) == 2


def test_the_client_shown_asks(edge: Edge, capsys: pytest.CaptureFixture[str]) -> None:
    url = edge(mode="policy").base_url
    for page, printed in (
        ("docs/guides/quick-start.md", r"collect from [012] at \d+ m/s: policy\n$"),
        ("README.md", r"0 \d+ policy\n$"),
    ):
        shown = blocks(page)
        assert '"http://localhost:8000"' in shown
        exec(shown.replace('"http://localhost:8000"', f'"{url}", timeout_s=60'), {})
        assert re.match(printed, capsys.readouterr().out)
