"""The table of what the fault suite found, in ``docs/results/faults.md``."""

from __future__ import annotations

from tests.support.places import ROOT

PAGE = ROOT / "docs" / "results" / "faults.md"

_INTRODUCTION = """# Faults, as measured

Written by `make faults`, which fails, kills and starves real processes on real sockets and files. A run in which a
test fails does not change this page. What the edge promises in each case: [Faults](../reference/faults.md).

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
        """All tables."""
        text = _INTRODUCTION
        for title, (columns, rows) in self._tables.items():
            names = [column.replace("_", " ") for column in columns]
            lines = [names, ["---"] * len(names), *rows]
            text += f"## {title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines) + "\n"
        return text
