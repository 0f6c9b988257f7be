"""The results page's tables: a result's measures and its paired comparisons, each narrow enough for a page.

Measures of one scenario have a row a scheme and a column a measure. A measure of several scenarios has its own table,
with a column a scenario.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from lab.experiments.claims import CLAIM_SEEDS
from lab.experiments.evidence import seeds_flown
from lab.experiments.plots import BOUND_LABEL, label_of, measured
from lab.experiments.result import Interval, Paired, Result

COLUMNS = 6
NONE, FEW = "–", " †"

Found = Interval | Paired | None


@dataclass(frozen=True)
class Table:
    """A table to print, with a cell a row and column.

    ``caption`` may be empty. A table without rows consists of its caption.
    """

    caption: str
    columns: list[str]
    rows: list[list[str]]


def measure_tables(result: Result) -> list[Table]:
    """The measures of every scheme; a mark at the label means few seeds."""
    measures = list(dict.fromkeys(m for found in result.schemes.values() for m in found))
    if any(_site_of(measure) for measure in measures):
        return _by_site(result, measures)
    remaining, tables = iter(measures), []
    while some := list(islice(remaining, COLUMNS)):
        rows = {row_label(result, name): [measured(result, name, m) for m in some] for name in result.schemes}
        if result.bound.keys() & set(some):
            rows[BOUND_LABEL] = [result.bound.get(m) for m in some]
        digits = [_digits(column) for column in zip(*rows.values(), strict=True)]
        texts = [[label, *map(cell, cells, digits)] for label, cells in rows.items()]
        tables.append(Table("", ["scheme", *(label_of(result, m) for m in some)], texts))
    return tables


def _by_site(result: Result, measures: Sequence[str]) -> list[Table]:
    tables = []
    for name, sites in _sites_of(measures).items():
        rows = {
            row_label(result, scheme): [measured(result, scheme, f"{name}@{site}") for site in sites]
            for scheme in result.schemes
        }
        if any(f"{name}@{site}" in result.bound for site in sites):
            rows[BOUND_LABEL] = [result.bound.get(f"{name}@{site}") for site in sites]
        digits = _digits([found for cells in rows.values() for found in cells])
        texts = {label: [cell(found, digits) for found in cells] for label, cells in rows.items()}
        caption = _sited_label(result, name, sites[0])
        values = {text for cells in texts.values() for text in cells} - {NONE}
        if len(values) == 1:
            tables.append(Table(f"{caption}: {values.pop()} for every scheme in every scenario", [], []))
        else:
            tables.append(Table(caption, ["scheme", *sites], [[label, *cells] for label, cells in texts.items()]))
    return tables


def pair_tables(result: Result) -> list[Table]:
    """Differences and ratios of schemes on the same worlds."""
    both: dict[tuple[str, str, str], dict[str, Paired]] = {}
    for found in result.paired:
        both.setdefault((found.scheme, found.reference, found.measure), {})[found.kind] = found
    if any(_site_of(measure) for _, _, measure in both):
        return _pairs_by_site(result, both)
    rows = [
        [
            label_of(result, scheme),
            _reference_label(result, reference),
            label_of(result, measure),
            *(_pair_cell(kinds.get(kind)) for kind in ("difference", "ratio")),
        ]
        for (scheme, reference, measure), kinds in both.items()
    ]
    return [Table("", ["scheme", "against", "measure", "difference", "ratio"], rows)] if rows else []


def _pairs_by_site(result: Result, both: Mapping[tuple[str, str, str], Mapping[str, Paired]]) -> list[Table]:
    tables = []
    order = list(dict.fromkeys(_site_of(measure) for found in result.schemes.values() for measure in found))
    for reference in dict.fromkeys(reference for _, reference, _ in both):
        compared = [(scheme, measure) for scheme, other, measure in both if other == reference]
        for name, found_at in _sites_of([measure for _, measure in compared]).items():
            # The first scheme may be paired on some sites alone.
            sites = sorted(found_at, key=order.index)
            for kind in ("difference", "ratio"):
                rows = [
                    [
                        label_of(result, scheme),
                        *(_pair_cell(both.get((scheme, reference, f"{name}@{site}"), {}).get(kind)) for site in sites),
                    ]
                    for scheme in dict.fromkeys(scheme for scheme, _ in compared)
                ]
                if all(text == NONE for row in rows for text in row[1:]):
                    continue
                caption = f"{_sited_label(result, name, sites[0])}: {kind} to {_reference_label(result, reference)}"
                tables.append(Table(caption, ["scheme", *sites], rows))
    return tables


def _site_of(measure: str) -> str:
    """The site in a measure's name, such as ``stress`` in ``events@stress``; empty for a result of one site."""
    return measure.partition("@")[2]


def _sites_of(measures: Sequence[str]) -> dict[str, list[str]]:
    """The sites of each measure, both in the order given."""
    sites: dict[str, list[str]] = {}
    for measure in dict.fromkeys(measures):
        name, _, site = measure.partition("@")
        sites.setdefault(name, []).append(site)
    return sites


def _sited_label(result: Result, name: str, site: str) -> str:
    return label_of(result, f"{name}@{site}").removesuffix(f", {site}")


def _reference_label(result: Result, name: str) -> str:
    return BOUND_LABEL if name == "bound" else label_of(result, name)


def row_label(result: Result, name: str) -> str:
    """A scheme's label, with a mark if its seeds are too few for a claim."""
    return label_of(result, name) + (FEW if seeds_flown(result, name) < CLAIM_SEEDS else "")


def _digits(found: Sequence[Found]) -> int:
    # A measure of at most 1 is a share or an index.
    return 3 if 0 < max((interval.mean for interval in found if interval), default=0.0) <= 1 else 1


def _pair_cell(found: Paired | None) -> str:
    return cell(found, 2 if found and (found.kind == "ratio" or abs(found.mean) <= 1) else 1)


def cell(found: Found, digits: int = 1) -> str:
    """A mean with its interval, with so many decimals below 100 and none from there on; a dash for ``None``."""
    if found is None:
        return NONE
    decimals = 0 if abs(found.mean) >= 100 else digits
    mean, low, high = (f"{number:,.{decimals}f}" for number in (found.mean, found.low, found.high))
    return mean if found.low == found.high else f"{mean} [{low}, {high}]"
