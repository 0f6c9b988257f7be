from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import pytest

from lab.experiments.catalogue import EXPERIMENTS
from lab.experiments.findings import tidy
from lab.experiments.page import (
    DATA,
    FIGURES,
    Swap,
    late_and_whole,
    main,
    packets_and_events,
    render_page,
    results_in,
    seeds_text,
    shown,
    stored_in,
    swap,
    write_page,
)
from lab.experiments.result import Paired, Result, Sweep
from lab.experiments.tables import cell
from simulator.errors import UsageError
from tests.support.made_results import CURVES, figure, interval, result, zero_from
from tests.support.places import ROOT

LATER = datetime(2026, 5, 6, tzinfo=UTC)


def scheduler() -> Result:
    return result(
        "scheduler",
        {"llm": {"lost_packets": interval(12.0, 10), "events": interval(5.0, 10)}, "eof": {"lost_packets": 176.4}},
        curves={"llm": zero_from(4), "eof": zero_from(20)},
        bound={"lost_packets": interval(0.8)},
        figures=[figure("curves", *CURVES, name="losses"), figure("bars", "lost_packets", name="totals")],
        paired=[
            Paired(scheme="llm", reference="eof", measure="lost_packets", kind="ratio", mean=0.07, low=0.05, high=0.09),
            Paired(scheme="llm", reference="bound", measure="lost_packets", kind="difference", mean=11, low=9, high=13),
        ],
        labels={"llm": "AIC-VDS, mode llm", "eof": "EOF", "lost_packets": "lost packets", "events": "loss events"},
        seeds_of={"llm": list(range(10))},
        notes=["A note of the run.", "Flights of several commits: 0123, 4567. Delete the folder flights/."],
    )


def stored(runs: Path, *results: Result) -> Path:
    for number, found in enumerate(results):
        folder = runs / f"{found.experiment}-{number}"
        folder.mkdir(parents=True)
        (folder / "results.json").write_text(found.model_dump_json())
    return runs


def page(runs: Path) -> str:
    out = runs / "docs" / "results.md"
    write_page(runs, out)
    return out.read_text()


def section(text: str, name: str) -> str:
    return text.split(f"\n### {name}\n")[1].split("\n### ", maxsplit=1)[0]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of one full run of the scheduler experiment; its folder had a figure of an older run."""
    runs = stored(tmp_path_factory.mktemp("runs"), scheduler())
    stale = runs / "docs" / "figures" / "scheduler" / "old.svg"
    stale.parent.mkdir(parents=True)
    stale.write_text("<svg/>")
    page(runs)
    return runs / "docs" / "results.md"


def test_an_experiment_with_a_result_has_its_origin_data_figure_and_numbers(written: Path) -> None:
    text = section(written.read_text(), "scheduler")
    for part in (
        "```sh\n.venv/bin/python -m lab experiment scheduler --llm none\n```", "seeds 0 to 29 (30), LLM tiny.gguf",
        "Commit 0123456789abcdef:", "[CSV](data/experiments/scheduler.csv)", "A note of the run.",
        "![What it shows.](figures/scheduler/totals.svg)",
        "| scheme | lost packets | loss events | to EOF |",
        "| AIC-VDS, mode llm (10 seeds) † | 12.0 | 5.0 | 0.07 [0.05, 0.09] |", "| EOF | 176 | – | 1 |",
        "| clairvoyant bound (proven) | 0.8 | – | – |",
    ):  # fmt: skip
        assert part in text, part
    assert "2026-01-02" not in text
    assert (written.parent / "data/experiments/scheduler.csv").read_text().startswith("scheme,seed,lost_packets,events")


def test_the_figure_that_it_shows_is_there_and_no_other(written: Path) -> None:
    linked = {written.parent / path for path in re.findall(r"\]\((figures/[^)]+)\)", written.read_text())}
    assert len(linked) == 1
    assert set((written.parent / "figures").rglob("*.*")) == linked
    assert all(path.read_text().endswith("</svg>\n") for path in linked)


def test_a_sweep_of_one_scheme_gives_way_to_the_curves() -> None:
    figures = [figure("curves", *CURVES, name="losses"), figure("sweep", "lost_packets", name="over_k")]
    sweep = Sweep(label="k", at={"llm": 5.0, "k3": 3.0})
    for flown, name in (({"llm"}, "losses"), ({"llm", "k3"}, "over_k")):
        made = result("top-k", {s: {"lost_packets": 1.0} for s in flown}, figures=figures, sweep=sweep)
        assert [one.name for one in shown(made)] == [name]


def test_experiments_without_a_result_are_named(written: Path) -> None:
    listed = section(written.read_text(), "Not flown")
    assert set(re.findall(r"`([a-z-]+)`", listed)) == EXPERIMENTS.keys() - {"scheduler"}


def test_the_page_is_made_again_from_its_data_alone(written: Path) -> None:
    before = {path: path.read_bytes() for path in written.parent.rglob("*") if path.is_file()}
    write_page(None, written)
    assert {path: path.read_bytes() for path in written.parent.rglob("*") if path.is_file()} == before


def test_a_later_run_replaces_an_experiments_data_and_a_quick_one_does_not(tmp_path: Path) -> None:
    out = tmp_path / "docs" / "results.md"
    write_page(stored(tmp_path / "first", scheduler()), out)
    later = scheduler().model_copy(update={"created_at": LATER, "figures": []})
    for made, commit in (({"quick": True, "commit": "c"}, "0123456789abcdef"), ({"commit": "d"}, "d")):
        write_page(stored(tmp_path / commit, later.model_copy(update=made)), out)
        assert stored_in(out.parent / DATA)["scheduler"].commit == commit


def test_the_page_that_ships_is_made_from_the_data_that_ships() -> None:
    """Nobody writes a number or a verdict by hand."""
    page, found = ROOT / "docs/results/experiments.md", stored_in(ROOT / "docs/results" / DATA)
    figures = page.parent / FIGURES
    drawn = {name: [(one, figures / name / f"{one.name}.svg") for one in shown(r)] for name, r in found.items()}
    assert all(path.is_file() for pictures in drawn.values() for _, path in pictures)
    assert render_page(found, drawn, page.parent) == page.read_text(encoding="utf-8")
    for name, made in found.items():
        assert made.commit and "dirty" not in made.commit and not made.quick
        assert (page.parent / DATA / f"{name}.csv").read_text(encoding="utf-8") == tidy(made)
    assert len(page.read_text(encoding="utf-8").splitlines()) <= 400


def test_the_papers_statements_have_our_numbers_and_a_verdict_each(written: Path) -> None:
    rows = dict(re.findall(r"^\| ([^|]+?) \| (.+) \|$", written.read_text(), re.MULTILINE))
    assert "zero from step 4" in rows["AIC-VDS loses nothing from step 4"]
    assert "**reproduced** †" in rows["AIC-VDS loses nothing from step 4"]
    assert "**reproduced** |" in rows["EOF reaches zero only by step 20"]
    assert "not measured" in rows["MADQN reaches zero only by step 27"]
    assert "not run" in rows["attention halves the prompt"]


def test_the_statements_are_judged_again_for_the_llm_with_its_adapter(written: Path, tmp_path: Path) -> None:
    heading = "with the embedded LLM and its adapter (tiny.gguf)"
    assert heading not in written.read_text()
    adapted = result("adapter-claims", {"llm": {"lost_packets": 42.0}}, curves={"llm": zero_from(30)})
    text = page(stored(tmp_path, scheduler(), adapted))
    rows = re.findall(r"^\| AIC-VDS loses nothing from step 4 \| (.+) \|$", text.split(heading)[1], re.MULTILINE)
    assert len(rows) == 1 and "**not reproduced** |" in rows[0] and "(#adapter-claims)" in rows[0]


def test_a_quick_run_is_marked_and_gets_no_verdict(tmp_path: Path) -> None:
    text = page(stored(tmp_path, scheduler().model_copy(update={"quick": True, "figures": []})))
    assert "**quick run**" in section(text, "scheduler")
    assert not re.search(r"\*\*(reproduced|not reproduced|not comparable)\*\*", text)
    assert "Not judged: no LLM has flown" in text


def test_a_full_run_counts_before_a_quick_one_and_the_latest_of_full_ones(tmp_path: Path) -> None:
    quick = scheduler().model_copy(update={"quick": True, "created_at": LATER})
    later = scheduler().model_copy(update={"created_at": LATER})
    assert results_in(stored(tmp_path, later, scheduler(), quick))["scheduler"] == later


def test_the_meaning_of_098_follows_from_measured_values(tmp_path: Path) -> None:
    fairness = result(
        "fairness",
        {
            "eof": {"jain": 0.855, "jain_scheduled": 0.89, "lost_packets": 176.0},
            "random": {"jain": 0.728, "jain_scheduled": 0.933, "lost_packets": 615.0},
            "round_robin": {"jain": 0.899, "jain_scheduled": 1.0, "lost_packets": 465.0},
        },
    )
    text = page(stored(tmp_path, fairness))
    assert "= 0.909, to the second order **0.911**" in text
    assert "never choose the same sensor, as here, E[X] = J - 3 and chance gives **0.929**" in text
    assert "a random fleet's have 0.933 here" in text
    assert "| EOF | 0.855 | 0.890 | 176 |" in text
    assert "the most even scheme is round robin (0.899, 465 packets lost)" in text
    assert "EOF (176), whose index is 0.855" in text


def test_two_schemes_that_swap_ranks_are_found(tmp_path: Path) -> None:
    lost = {"llm": (180.0, 20.0), "eof": (30.0, 50.0), "wqcs": (240.0, 60.0)}
    made = result(
        "scheduler",
        {name: {"lost_packets": packets, "events": events} for name, (packets, events) in lost.items()},
        curves={"llm": zero_from(20, before=9.0), "eof": zero_from(30, before=1.0), "wqcs": zero_from(30, before=8.0)},
        labels={"llm": "AIC-VDS"},
    )
    assert swap(late_and_whole(made)) == Swap("AIC-VDS", "EOF", (0.0, 10.0), (180.0, 30.0))
    assert swap(packets_and_events(made)) == Swap("EOF", "AIC-VDS", (30.0, 180.0), (50.0, 20.0))
    text = " ".join(page(stored(tmp_path, made)).split())
    assert "in the last third of the mission AIC-VDS loses fewer packets than EOF (0.0 to 10.0)" in text
    assert "EOF loses fewer packets than AIC-VDS (30.0 to 180) in more events (50.0 to 20.0)" in text


def test_means_of_fewer_worlds_are_not_put_beside_the_others(tmp_path: Path) -> None:
    """The easiest ten worlds make any scheme look good."""
    few = {"seeds_of": {"guided": list(range(10))}, "curves": {"guided": zero_from(20, before=9.0)}}
    made = result(
        "fairness",
        {
            "eof": {"jain": 0.8, "lost_packets": 30.0, "events": 20.0},
            "guided": {"jain": interval(0.9, seeds=10), "lost_packets": interval(10.0, seeds=10), "events": 40.0},
            "random": {"jain": 0.7, "lost_packets": 615.0, "events": 90.0},
        },
        **few,
    )
    assert list(late_and_whole(made)) == []
    assert "guided" not in packets_and_events(made) and "EOF" in packets_and_events(made)
    text = " ".join(page(stored(tmp_path, made)).split())
    assert "EOF is the most even scheme by visits served (0.800), and none loses fewer packets (30.0;" in text


def test_schemes_with_equal_ranks_do_not_swap() -> None:
    assert swap({"llm": (1.0, 2.0), "eof": (2.0, 3.0)}) is None
    assert swap(late_and_whole(None)) is None


def test_a_folder_without_results_or_with_a_broken_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"has no results\.json; make some with: python -m lab experiment all --out"):
        write_page(tmp_path, tmp_path / "results.md")
    with pytest.raises(UsageError, match=r"has no results; take some in with --runs DIR"):
        write_page(None, tmp_path / "results.md")
    broken = tmp_path / "tokens" / "results.json"
    broken.parent.mkdir()
    broken.write_text('{"experiment": "tokens"}')
    with pytest.raises(UsageError, match=r"tokens/results\.json: title: Field required; run that experiment again"):
        write_page(tmp_path, tmp_path / "results.md")


def test_an_experiment_that_the_catalogue_lacks_is_shown_too(tmp_path: Path) -> None:
    assert "3.0" in section(page(stored(tmp_path, result("training", {"madqn": {"return": 3.0}}))), "training")


def test_numbers_have_as_many_digits_as_their_precision_allows() -> None:
    assert cell(None) == "–"
    assert cell(interval(1234.5)) == "1,234"
    assert cell(interval(0.98), 3) == "0.980"
    assert cell(interval(10.0, spread=2.0)).count(".") == 3
    assert seeds_text([0, 1, 2]) == "0 to 2 (3)"
    assert seeds_text([4, 7]) == "4, 7 (2)"


def test_the_command_writes_the_page_or_names_the_missing_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = stored(tmp_path / "runs", scheduler().model_copy(update={"figures": []}))
    assert main(["--runs", str(runs), "--out", str(tmp_path / "docs" / "results.md")]) == 0
    assert (tmp_path / "docs" / "results.md").read_text().startswith("<!-- Made by `python -m lab experiment page`")
    assert main(["--runs", str(tmp_path / "none"), "--out", str(tmp_path / "results.md")]) == 2
    assert "python -m lab experiment all --out" in " ".join(capsys.readouterr().err.split())
