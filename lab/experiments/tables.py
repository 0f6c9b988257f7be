"""The results page's tables: a result's first measures and its ratios on the same worlds, narrow enough for a page.

A result of one scenario has one table, with a row a scheme. One of several scenarios has a column a scenario: in a
table of its first measure, and in those of the ratios to the first reference and to each scenario's best heuristic.
The data files have every measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lab.experiments.claims import CLAIM_SEEDS
from lab.experiments.comparisons import BEST
from lab.experiments.evidence import seeds_flown
from lab.experiments.plots import BOUND_LABEL, label_of, measured
from lab.experiments.result import Interval, Paired, Result

MEASURES, REFERENCES = 4, 3
NONE, FEW = "–", " †"
# The measure whose ratios are shown, where it is compared at all.
_LOST = "lost_packets"

Found = Interval | Paired | None


@dataclass(frozen=True)
class Table:
    """A table to print, with a cell a row and column; ``caption`` may be empty."""

    caption: str
    columns: list[str]
    rows: list[list[str]]


def tables_of(result: Result) -> list[Table]:
    """The tables of a result; a mark at a scheme's label means few seeds."""
    measures = list(dict.fromkeys(m for found in result.schemes.values() for m in found))
    sites = list(dict.fromkeys(site for m in measures if (site := m.partition("@")[2])))
    return _by_site(result, measures[0].partition("@")[0], sites) if sites else [_whole(result, measures)]


def _whole(result: Result, measures: Sequence[str]) -> Table:
    found = {m: [measured(result, name, m) for name in result.schemes] for m in measures}
    differing = [m for m, of_schemes in found.items() if len({each and each.mean for each in of_schemes}) > 1]
    shown = (differing or list(measures))[:MEASURES]
    rows = {row_label(result, name): [found[m][n] for m in shown] for n, name in enumerate(result.schemes)}
    digits = [_digits(column) for column in zip(*rows.values(), strict=True)]
    ratios = _ratios(result, _compared(result))
    columns = _references(result, ratios)
    texts = []
    for name, (label, cells) in zip(result.schemes, rows.items(), strict=True):
        own = [_ratio(ratios, name, reference) for reference in columns] if columns else _named(result, ratios, name)
        texts.append([label, *map(cell, cells, digits), *own])
    if result.bound.keys() & set(shown):
        least = [cell(result.bound.get(m), places) for m, places in zip(shown, digits, strict=True)]
        texts.append([BOUND_LABEL, *least, *([NONE] * (len(texts[0]) - len(least) - 1))])
    heads = [f"to {_label(result, reference)}" for reference in columns] or (["ratio"] if ratios else [])
    if heads and shown[0] != _compared(result):
        heads = [f"{label_of(result, _compared(result))}, {head}" for head in heads]
    return Table("", ["scheme", *(label_of(result, m) for m in shown), *heads], texts)


def _by_site(result: Result, measure: str, sites: Sequence[str]) -> list[Table]:
    caption = label_of(result, f"{measure}@{sites[0]}").removesuffix(f", {sites[0]}")
    rows = {
        row_label(result, name): [measured(result, name, f"{measure}@{site}") for site in sites]
        for name in result.schemes
    }
    if any(f"{measure}@{site}" in result.bound for site in sites):
        rows[BOUND_LABEL] = [result.bound.get(f"{measure}@{site}") for site in sites]
    digits = _digits([found for cells in rows.values() for found in cells])
    texts = [[label, *(cell(found, digits) for found in cells)] for label, cells in rows.items()]
    tables = [Table(caption, ["scheme", *sites], texts)]
    at = {site: _ratios(result, f"{measure}@{site}") for site in sites}
    references = _references(result, {key: pair for ratios in at.values() for key, pair in ratios.items()})
    for reference in (r for r in references if r in (references[0], BEST)):
        texts = [
            [label_of(result, name), *(_ratio(at[site], name, reference) for site in sites)] for name in result.schemes
        ]
        tables.append(Table(f"{caption}: ratio to {_label(result, reference)}", ["scheme", *sites], texts))
    return tables


def _compared(result: Result) -> str:
    """The measure whose ratios are shown."""
    names = [pair.measure for pair in result.paired]
    return _LOST if _LOST in names or not names else names[0]


def _ratios(result: Result, measure: str) -> dict[tuple[str, str], Paired]:
    return {(p.scheme, p.reference): p for p in result.paired if p.measure == measure and p.kind == "ratio"}


def _references(result: Result, ratios: dict[tuple[str, str], Paired]) -> list[str]:
    """The references that at least half of the other schemes are compared with."""
    found = dict.fromkeys(reference for _, reference in ratios)
    enough = [r for r in found if 2 * sum(other == r for _, other in ratios) >= len(result.schemes) - 1]
    return enough[:REFERENCES]


def _ratio(ratios: dict[tuple[str, str], Paired], name: str, reference: str) -> str:
    return "1" if name == reference else cell(ratios.get((name, reference)), 2)


def _named(result: Result, ratios: dict[tuple[str, str], Paired], name: str) -> list[str]:
    """The column of ratios to a reference that differs by scheme; none without any ratio."""
    own = [f"{cell(pair, 2)} to {_label(result, other)}" for (scheme, other), pair in ratios.items() if scheme == name]
    return ["; ".join(own) or NONE] if ratios else []


def _label(result: Result, name: str) -> str:
    return "the bound" if name == "bound" else result.labels.get(name) or label_of(result, name)


def row_label(result: Result, name: str) -> str:
    """A scheme's label, with a mark if its seeds are too few for a claim."""
    return label_of(result, name) + (FEW if seeds_flown(result, name) < CLAIM_SEEDS else "")


def _digits(found: Sequence[Found]) -> int:
    # A measure of at most 1 is a share or an index.
    return 3 if 0 < max((interval.mean for interval in found if interval), default=0.0) <= 1 else 1


def cell(found: Found, digits: int = 1) -> str:
    """A mean with its interval, with ``digits`` decimals below 100 and none from 100 on; a dash for ``None``."""
    if found is None:
        return NONE
    decimals = 0 if abs(found.mean) >= 100 else digits
    mean, low, high = (f"{number:,.{decimals}f}" for number in (found.mean, found.low, found.high))
    return mean if found.low == found.high else f"{mean} [{low}, {high}]"
