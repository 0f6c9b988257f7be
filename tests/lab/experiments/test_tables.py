from __future__ import annotations

from lab.experiments.result import Paired, Result
from lab.experiments.tables import Table, measure_tables, pair_tables
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


def in_two_scenarios(llm_decided_pct: float) -> Result:
    return result(
        "scenarios",
        {
            "llm": {"lost_packets@paper": interval(12.0, 10), "llm_decided_pct@paper": interval(llm_decided_pct, 10)},
            "eof": {"lost_packets@paper": 176.0, "llm_decided_pct@paper": 0.0, "lost_packets@dense": 1284.0,
                    "llm_decided_pct@dense": 0.0},
        },
        labels=LABELS,
        seeds_of={"llm": list(range(10))},
        paired=[pair("difference", "lost_packets@paper", -164.0), pair("ratio", "lost_packets@paper", 0.07),
                pair("difference", "lost_packets@dense", 3.0)],
    )  # fmt: skip


def test_measures_of_several_scenarios_have_a_table_each_and_a_column_a_scenario() -> None:
    assert measure_tables(in_two_scenarios(90.0)) == [
        Table(
            "lost packets",
            ["scheme", "paper", "dense"],
            [["AIC-VDS (10 seeds) †", "12.0", "–"], ["EOF", "176", "1,284"]],
        ),
        Table(
            "decided by the LLM, %",
            ["scheme", "paper", "dense"],
            [["AIC-VDS (10 seeds) †", "90.0", "–"], ["EOF", "0.0", "0.0"]],
        ),
    ]


def test_a_measure_with_equal_values_has_one_line() -> None:
    [_, decided] = measure_tables(in_two_scenarios(0.0))
    assert decided == Table("decided by the LLM, %: 0.0 for every scheme in every scenario", [], [])


def test_pairs_in_several_scenarios_have_a_table_a_measure_and_kind() -> None:
    assert pair_tables(in_two_scenarios(0.0)) == [
        Table("lost packets: difference to EOF", ["scheme", "paper", "dense"], [["AIC-VDS (10 seeds)", "-164", "3.0"]]),
        Table("lost packets: ratio to EOF", ["scheme", "paper", "dense"], [["AIC-VDS (10 seeds)", "0.07", "–"]]),
    ]


def test_pairs_in_one_scenario_stand_in_one_table() -> None:
    made = result(
        "scheduler",
        {"llm": {"lost_packets": 12.0}, "eof": {"lost_packets": 176.0}},
        labels={"llm": "AIC-VDS", "eof": "EOF", "lost_packets": "lost packets"},
        paired=[pair("difference", "lost_packets", -164.0), pair("ratio", "lost_packets", 0.07)],
    )
    assert pair_tables(made) == [
        Table(
            "",
            ["scheme", "against", "measure", "difference", "ratio"],
            [["AIC-VDS", "EOF", "lost packets", "-164", "0.07"]],
        )
    ]
    assert pair_tables(made.model_copy(update={"paired": []})) == []


def test_many_measures_of_one_scenario_are_spread_over_tables_that_fit_the_page() -> None:
    made = result("scheduler", {"eof": {f"measure_{number}": float(number) for number in range(8)}})
    assert [len(table.columns) for table in measure_tables(made)] == [7, 3]
