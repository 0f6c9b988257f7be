"""The documentation builds without a warning, needs nothing from elsewhere, and its Python runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Edge
from tests.support.places import ROOT

# Where a reader is led, not what a page loads.
LINKS = re.compile(r"<a [^>]*>")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CODE_PATH = re.compile(r"(?<![\w./-])(?:service|simulator|shared)/[\w./-]*")
CODE_NAME = re.compile(r"`((?:service|simulator|shared)/[\w/]+\.py):([\w.]+)`")
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
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert pages and all((site / f"{page}.html").exists() for page in pages)
    assert (site / "search" / "search_index.json").stat().st_size > 10_000


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.glob("**/*.html"):
        assert not LOADED.findall(LINKS.sub("", page.read_text(encoding="utf-8"))), page.name


def test_equations_are_drawn(site: Path) -> None:
    method = (site / "method.html").read_text(encoding="utf-8")
    asked = (ROOT / "docs" / "method.md").read_text(encoding="utf-8").count("$$") // 2
    assert asked > 5
    assert method.count('<p class="equation"><svg') == asked
    assert "arithmatex" not in method and "merror" not in method


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_of_the_code_exists(page: Path) -> None:
    paths = {path.rstrip(".-/") for path in CODE_PATH.findall(page.read_text(encoding="utf-8"))}
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_every_name_in_the_architecture_is_in_its_file() -> None:
    named = CODE_NAME.findall((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))
    assert len(named) > 30
    defined = {path: (ROOT / path).read_text(encoding="utf-8") for path, _ in named}
    for path, name in named:
        for part in name.split("."):
            definition = rf"^ *(?:async )?(?:def|class) {part}\b|^{part}\b.* = "
            assert re.search(definition, defined[path], re.MULTILINE), f"{path} defines no {name}"


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 110


def blocks(page: str) -> str:
    """A page's Python, as one program."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


def test_the_policy_shown_flies(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(blocks("docs/your-policy.md").replace("range(5)", "range(1)"), names)
    assert re.match(r"mine \[\d+\]\neof \[\d+\]\n$", capsys.readouterr().out)


def test_the_client_shown_asks(edge: Edge, capsys: pytest.CaptureFixture[str]) -> None:
    url = edge(mode="policy").base_url
    for page, printed in (
        ("docs/quick-start.md", r"collect from [012] at \d+ m/s: policy\n$"),
        ("README.md", r"0 \d+ policy\n$"),
    ):
        shown = blocks(page)
        assert '"http://localhost:8000"' in shown
        exec(shown.replace('"http://localhost:8000"', f'"{url}", timeout_s=60'), {})
        assert re.match(printed, capsys.readouterr().out)
