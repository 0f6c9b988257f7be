from __future__ import annotations

from typing import Any

from lab.experiments.plots import BOUND_LABEL
from lab.experiments.result import Paired, Result
from lab.experiments.tables import MEASURES, Table, tables_of
from tests.support.made_results import interval, result

LABELS = {
    "llm": "AIC-VDS",
    "eof": "EOF",
    "lost_packets@paper": "lost packets, paper",
    "lost_packets@dense": "lost packets, dense",
    "llm_decided_pct@paper": "decided by the LLM, %, paper",
    "llm_decided_pct@dense": "decided by the LLM, %, dense",
}


def pair(kind: str, measure: str, mean: float) -> Paired:
    return Paired.model_validate(
        {"scheme": "llm", "reference": "eof", "measure": measure, "kind": kind, "mean": mean, "low": mean, "high": mean}
    )


def test_a_result_of_several_scenarios_has_its_first_measure_and_the_ratios_with_a_column_a_scenario() -> None:
    made = result(
        "scenarios",
        {
            "llm": {"lost_packets@paper": interval(12.0, 10), "llm_decided_pct@paper": interval(90.0, 10)},
            "eof": {"lost_packets@paper": 176.0, "llm_decided_pct@paper": 0.0, "lost_packets@dense": 1284.0},
        },
        labels=LABELS,
        seeds_of={"llm": list(range(10))},
        paired=[pair("difference", "lost_packets@paper", -164.0), pair("ratio", "lost_packets@paper", 0.07)],
    )
    assert tables_of(made) == [
        Table(
            "lost packets",
            ["scheme", "paper", "dense"],
            [["AIC-VDS (10 seeds) †", "12.0", "–"], ["EOF", "176", "1,284"]],
        ),
        Table(
            "lost packets: ratio to EOF",
            ["scheme", "paper", "dense"],
            [["AIC-VDS (10 seeds)", "0.07", "–"], ["EOF", "1", "1"]],
        ),
    ]


def in_one_scenario(**changes: Any) -> Result:
    schemes = {"llm": {"lost_packets": 12.0, "velocity": 7.0}, "eof": {"lost_packets": 176.0, "velocity": 7.0}}
    labels = {"llm": "AIC-VDS", "eof": "EOF", "lost_packets": "lost packets"}
    return result("scheduler", schemes, **{"labels": labels, **changes})


def test_a_measure_that_is_the_same_for_every_scheme_is_left_to_the_data() -> None:
    [table] = tables_of(in_one_scenario())
    assert table == Table("", ["scheme", "lost packets"], [["AIC-VDS", "12.0"], ["EOF", "176"]])


def test_a_reference_of_most_schemes_has_a_column_and_the_bound_a_row() -> None:
    bound = {"lost_packets": interval(0.5)}
    [table] = tables_of(in_one_scenario(paired=[pair("ratio", "lost_packets", 0.07)], bound=bound))
    assert table.columns == ["scheme", "lost packets", "to EOF"]
    assert table.rows == [["AIC-VDS", "12.0", "0.07"], ["EOF", "176", "1"], [BOUND_LABEL, "0.5", "–"]]


def test_a_reference_of_one_scheme_among_many_is_named_in_its_row() -> None:
    schemes = {name: {"lost_packets": number} for number, name in enumerate(("llm", "eof", "wqcs", "random"), 1)}
    made = result("attention", schemes, labels=LABELS, paired=[pair("ratio", "lost_packets", 0.5)])
    [table] = tables_of(made)
    assert table.columns == ["scheme", "lost packets", "ratio"]
    assert [row[-1] for row in table.rows] == ["0.50 to EOF", "–", "–", "–"]


def test_the_page_has_the_first_measures_alone() -> None:
    made = result("scheduler", {s: {f"m{n}": n + len(s) for n in range(9)} for s in ("eof", "wqcs")})
    [table] = tables_of(made)
    assert len(table.columns) == 1 + MEASURES
