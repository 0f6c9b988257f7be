"""The suite's table."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.table import PAGE, Tables


@pytest.fixture(autouse=True, scope="module")
def made_missions(made_on_decide: None) -> None:
    """No test here is about missions that there are not."""


@pytest.fixture(scope="session")
def tables(request: pytest.FixtureRequest) -> Iterator[Tables]:
    """Where each test writes what it measured; a run of the whole suite that passes makes the page anew."""
    kept = Tables()
    yield kept
    session = request.session
    ran = {Path(item.path).name for item in session.items}
    suites = ("hostile_clients", "kills", "owners", "ray", "sigterm", "upstreams")
    whole = ran >= {f"test_{suite}.py" for suite in suites} and not session.config.option.keyword
    text = kept.page()
    if whole and not session.testsfailed:
        PAGE.write_text(text)
    print(text)
