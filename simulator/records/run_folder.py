"""The folder of a run: the names of its files, and making it."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from simulator.errors import UsageError

SUMMARY, DECISIONS, REPORT, REQUESTS = "summary.json", "decisions.jsonl", "report.html", "requests.jsonl"
FIGURES = "figures"
# The figures for print that a mission may have.
DRAWN = tuple(
    f"{FIGURES}/{name}.{kind}"
    for name in ("latency-map", "latency-steps", "losses", "tokens", "visits", "deciders")
    for kind in ("svg", "pdf")
)


def refuse_old_result(out: Path, overwrite: bool, result: str = SUMMARY) -> None:
    """Raises ``UsageError`` if ``out`` is no folder, or contains a result and ``overwrite`` is false."""
    with naming_out(out):
        if out.exists() and not out.is_dir():
            raise UsageError(f"--out {out} is a file; name a folder")
        present = (out / result).exists()
    if present and not overwrite:
        what = "a mission's result" if result == SUMMARY else f"a {result}"
        raise UsageError(f"--out {out} already has {what}; choose another folder or add --overwrite")


def fresh_folder(out: Path, stale: Iterable[str] = (SUMMARY, REPORT, REQUESTS, *DRAWN)) -> None:
    """Make the folder, and delete stale files of an earlier mission in it.

    Raises:
        UsageError: the folder cannot be written.
    """
    with naming_out(out):
        out.mkdir(parents=True, exist_ok=True)
        for name in stale:
            (out / name).unlink(missing_ok=True)


@contextmanager
def naming_out(out: Path) -> Iterator[None]:
    """Within the context, an ``OSError`` becomes a ``UsageError`` that names the option ``--out``."""
    try:
        yield
    except OSError as error:
        at = f" ({error.filename})" if error.filename and str(error.filename) != str(out) else ""
        raise UsageError(f"--out {out}: {error.strerror or error}{at}") from None
