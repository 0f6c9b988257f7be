"""Flights without a drawn report, for tests that do not check it: drawing one takes seconds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def reports_undrawn() -> Iterator[None]:
    """``aicvds simulate``, run in this process, leaves a page of two words and no figures."""

    def write_report(page: Path, *_: object) -> None:
        page.write_text("not drawn", encoding="utf-8")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("simulator.reporting.html_report.write_report", write_report)
        yield
