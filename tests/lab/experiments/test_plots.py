from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest
from PIL import Image

from lab.experiments.plots import BOUND_LABEL, draw, label_of, styles
from lab.experiments.result import Result, Sweep
from simulator.reporting.figure_style import DOUBLE_IN, SINGLE_IN
from tests.support.made_results import CURVES, figure, interval, result, zero_from

SCHEMES = [
    "llm", "llm_all", "value", "edge_policy", "madqn", "mappo", "mpc", "eof", "wqcs",
    "longest_queue_fast", "queue_and_channel_fast",
    "max_gain", "nearest", "round_robin", "random", "csv_score_6", "json_shuffled_30",
]  # fmt: skip
LABELS = {"llm": "AIC-VDS, mode llm", "lost_packets": "lost packets", "mpc": "MPC (horizon 8)"}


def made(count: int = 16, seeds: int = 30, growth: float = 1.5) -> Result:
    measures = {
        name: {
            "lost_packets": interval(10 * growth**rank, seeds, 2.0 if seeds > 1 else 0.0),
            "events": interval(3.0 + rank, seeds),
            "jain": interval(0.9 + rank / 1000, seeds),
        }
        for rank, name in enumerate(SCHEMES[:count])
    }
    return result(
        "scheduler",
        measures,
        curves={name: zero_from(5 + rank, 2.0 + rank) for rank, name in enumerate(SCHEMES[:count])},
        bound={"lost_packets": interval(1.5), "lost_packets_cumulative": interval(1.5)},
        seeds=list(range(seeds)),
        labels=LABELS,
    )


def swept(seeds: int = 30) -> Result:
    top_ks = {f"k{k}": float(k) for k in (1, 3, 5, 10)}
    measures = {name: {"lost_packets": interval(100 / k, seeds, 1.0 if seeds > 1 else 0)} for name, k in top_ks.items()}
    return result(
        "top-k", {**measures, "eof": {"lost_packets": 80.0}}, seeds=list(range(seeds)),
        bound={"lost_packets": interval(1.5)}, sweep=Sweep(label="sensors kept, k", at=top_ks),
    )  # fmt: skip


def words(path: Path) -> set[str]:
    return {text.strip() for node in ElementTree.parse(path).iter() for text in node.itertext() if text.strip()}


@pytest.mark.parametrize(
    ("drawn", "labels"),
    [
        (made().model_copy(update={"figures": [figure("curves", *CURVES)]}), {"AIC-VDS, mode llm", "step", "random"}),
        (made(2, 1).model_copy(update={"figures": [figure("curves", CURVES[1])]}), {"AIC-VDS, mode llm"}),
        (made().model_copy(update={"figures": [figure("bars", "lost_packets", "events", "jain")]}), {"lost packets"}),
        (made(2, 1).model_copy(update={"figures": [figure("bars", "lost_packets")]}), {"lost packets"}),
        (swept().model_copy(update={"figures": [figure("sweep", "lost_packets")]}), {"sensors kept, k", "EOF"}),
        (swept(1).model_copy(update={"figures": [figure("sweep", "lost_packets")]}), {"sensors kept, k"}),
    ],
)
def test_every_kind_of_figure_has_labels(drawn: Result, labels: set[str], tmp_path: Path) -> None:
    paths = draw(drawn, tmp_path)
    assert [path.name for path in paths] == ["drawn.png", "drawn.svg", "drawn.pdf"]
    assert labels | {BOUND_LABEL} <= words(tmp_path / "drawn.svg")
    assert (tmp_path / "drawn.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(("measures", "inches"), [(["lost_packets"], SINGLE_IN), (["lost_packets", "jain"], DOUBLE_IN)])
def test_a_figure_is_as_wide_as_a_papers_columns(measures: list[str], inches: float, tmp_path: Path) -> None:
    draw(made(3).model_copy(update={"figures": [figure("bars", *measures)]}), tmp_path, ("png",))
    with Image.open(tmp_path / "drawn.png") as image:
        assert image.width == pytest.approx(300 * inches, abs=1)
        assert image.info["dpi"] == pytest.approx((300, 300), abs=1)


def test_the_same_result_makes_the_same_bytes(tmp_path: Path) -> None:
    drawn = made(4).model_copy(update={"figures": [figure("bars", "jain")]})
    first, second = (draw(drawn, tmp_path / name) for name in ("a", "b"))
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_numbers_that_are_none_leave_the_rest_to_be_drawn(tmp_path: Path) -> None:
    nothing = interval(0.0)
    gone = nothing.model_copy(update={"mean": math.nan})
    curves = zero_from(5)
    torn = curves["events_per_step"].model_copy(update={"mean": [math.nan, *curves["events_per_step"].mean[1:]]})
    drawn = result(
        "scheduler",
        {"llm": {"lost_packets": nothing}, "eof": {"lost_packets": gone}, "wqcs": {"lost_packets": 400.0, "jain": 0.9}},
        curves={"llm": curves, "eof": {"events_per_step": torn}},
        figures=[figure("bars", "lost_packets", "jain"), figure("curves", *CURVES, name="torn")],
    )
    draw(drawn, tmp_path, ("svg",))
    text = (tmp_path / "drawn.svg").read_text() + (tmp_path / "torn.svg").read_text()
    assert "not measured" in text
    assert "nan" not in text.lower()


def test_a_figure_without_measurements_is_omitted(tmp_path: Path) -> None:
    drawn = made(2).model_copy(update={"figures": [figure("bars", "rtt_p50", name="no"), figure("bars", "jain")]})
    assert {path.stem for path in draw(drawn, tmp_path, ("svg",))} == {"drawn"}


def test_a_sweep_without_an_x_axis_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'drawn' of 'scheduler' is a sweep"):
        draw(made(2).model_copy(update={"figures": [figure("sweep", "jain")]}), tmp_path)


def test_no_two_schemes_look_alike_and_known_ones_look_the_same_everywhere() -> None:
    many = styles(result("ablation-prompt", {name: {} for name in [*SCHEMES, *(f"cell_{n}" for n in range(8))]}))
    assert len(set(map(str, many.values()))) == len(many)
    assert styles(made(1))["llm"] == many["llm"]


def test_the_label_of_a_scheme_with_fewer_seeds_has_their_number() -> None:
    assert label_of(made().model_copy(update={"seeds_of": {"mpc": [0, 1]}}), "mpc").endswith("(2 seeds)")
