"""The table of what the fault suite found, in ``docs/faults.md``."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime

from tests.support.places import ROOT

PAGE = ROOT / "docs" / "faults.md"

_INTRODUCTION = """# What goes wrong, and what the edge does

Made by `make faults` on {day}, commit `{commit}`: real processes, real sockets, real files. A run in which anything
fails does not change this page.

"""


class Tables:
    """Rows by table, in the order of the tests; as one page."""

    def __init__(self) -> None:
        self._tables: dict[str, tuple[tuple[str, ...], list[tuple[str, ...]]]] = {}

    def add(self, title: str, **row: object) -> None:
        """One row of the table with that title; the first row's names are its columns."""
        columns, rows = self._tables.setdefault(title, (tuple(row), []))
        rows.append(tuple(str(row.get(column, "")) for column in columns))

    def page(self) -> str:
        """All tables, with the day and the commit."""
        commit = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=False
        ).stdout.strip()
        text = _INTRODUCTION.format(day=f"{datetime.now(UTC):%Y-%m-%d}", commit=commit or "unknown")
        for title, (columns, rows) in self._tables.items():
            names = [column.replace("_", " ") for column in columns]
            lines = [names, ["---"] * len(names), *rows]
            text += f"## {title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines) + "\n"
        return text
