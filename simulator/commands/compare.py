"""``aicvds compare``: several missions side by side."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from simulator.commands.running import command_main
from simulator.errors import UsageError
from simulator.records.run_folder import naming_out


@dataclass(frozen=True)
class Compare:
    """Set two or more missions side by side: a table here, and a page with the table and the figures.

    A mission is the --out folder of `aicvds simulate` or `demo`.

    Try it:

      aicvds simulate --policy eof --out runs/eof

      aicvds simulate --policy wqcs --out runs/wqcs

      aicvds compare runs/eof runs/wqcs

    Exit code: 0 done, 2 bad use.
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN RUN...")]
    """The missions' folders."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("runs/compare.html")
    """The page to write."""


def main(argv: list[str]) -> int:
    """Run ``aicvds compare``; returns the exit code."""
    return command_main(Compare, "aicvds compare", argv, compare)


def compare(options: Compare, console: Console) -> int:
    """Print the table and write the page; returns the exit code.

    Raises:
        UsageError: fewer than two runs, one that cannot be read, or a page that cannot be written or is another file.
    """
    if len(options.runs) < 2:
        raise UsageError("name two or more missions' folders, such as runs/eof runs/wqcs")
    from simulator.reporting.comparison import caution, names, read_result, render_comparison, rows

    runs = [read_result(folder) for folder in options.runs]
    table = Table("")
    for name in names(runs):
        # A name's end may be all in which two runs differ.
        table.add_column(name, overflow="fold")
    for name, cells in rows(runs).items():
        table.add_row(name, *cells)
    console.print(table)
    console.print(caution(runs), markup=False, highlight=False, soft_wrap=True)
    with naming_out(options.out):
        options.out.parent.mkdir(parents=True, exist_ok=True)
        if options.out.exists() and b"missions compared</title>" not in options.out.read_bytes():
            raise UsageError(f"--out {options.out} is there already and is no comparison: choose another file")
        options.out.write_text(render_comparison(runs), encoding="utf-8")
    console.print(f"Wrote {options.out}", markup=False, highlight=False, soft_wrap=True)
    return 0
