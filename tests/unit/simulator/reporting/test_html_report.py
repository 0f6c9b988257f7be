from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from shared.wire.names import Names
from shared.world.scenario import SCENARIOS, Scenario
from simulator.flying.flight import baselines, fly
from simulator.flying.pilots import LocalPilot
from simulator.records.decision import Decision
from simulator.records.flight import Flight
from simulator.records.summary import LossBound, Summary, summarise
from simulator.reporting import figures
from simulator.reporting.figure_style import PaperFigure
from simulator.reporting.html_report import costliest, drawings, playback, render_report, write_report
from simulator.reporting.wording import llm_notice, policy_labels
from simulator.sites.site import Site

SHORT = Scenario(steps=5)
Drawn = dict[str, PaperFigure]
EVIL = '<script>alert("$x$")</script>&amp;'
SECTIONS = (
    "outcome",
    "playback",
    "latency",
    "loss",
    "tokens",
    "visits",
    "deciders",
    "decisions",
    "glossary",
    "provenance",
)


def decision(**changes: object) -> Decision:
    base = {"step": 0, "uav_id": 0, "position": (1.0, 2.0), "sensor_id": 0, "velocity": 3, "source": "onboard"}
    return Decision.model_validate({**base, **changes})


def page(
    flight: Flight,
    model: str | None = "stub-1",
    decisions: list[Decision] | None = None,
    figures: Drawn | None = None,
) -> str:
    seen = flight.decisions if decisions is None else decisions
    summary = summary_of(flight, model)
    figures = figures or drawings_of(flight, summary, seen)
    played = playback(flight.scenario, flight.sensor_xy, seen, flight.track.until(flight.steps_flown), 1)
    return render_report(summary, flight.scenario, seen, figures, played)


def drawings_of(flight: Flight, summary: Summary, decisions: list[Decision]) -> Drawn:
    tallies = {"aic_vds": flight.tally, **baselines(Site(flight.scenario), 0, flight.steps_flown)}
    return drawings(summary, flight.scenario, decisions, tallies, flight.sensor_xy)


def summary_of(flight: Flight, model: str | None) -> Summary:
    facts = flight.facts(
        policy="edge", edge="http://edge:8000", mission_id="paper-0-1", mode="llm", model=model,
        deadline_ms=None, command="aicvds simulate",
    )  # fmt: skip
    return summarise(facts, flight.decisions, {"aic_vds": flight.tally})


@pytest.fixture(scope="module")
def flight() -> Flight:
    """A flight in which every second decision has the fields of an edge's decision."""
    flown = fly(Site(SHORT), LocalPilot("eof", SHORT, 0), seed=0)
    flown.decisions = [
        d.model_copy(update={"rtt_ms": 10.0 + n, "source": "llm", "attempts": 1, "request_bytes": 900}) if n % 2 else d
        for n, d in enumerate(flown.decisions)
    ]
    return flown


@pytest.fixture(scope="module")
def figures_of(flight: Flight) -> Drawn:
    """The figures of that flight."""
    return drawings_of(flight, summary_of(flight, "stub-1"), flight.decisions)


@pytest.fixture(scope="module")
def drawn(flight: Flight, figures_of: Drawn) -> str:
    """The flight's page."""
    return page(flight, figures=figures_of)


class Page(HTMLParser):
    """Collects IDs, and the addresses that a browser would follow or load."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.loaded: list[str] = []
        self.tags: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in ("src", "href", "xlink:href", "data", "action", "poster", "srcset"):
                self.loaded.append(value or "")


def test_every_section_is_there(drawn: str) -> None:
    for section in SECTIONS:
        assert f'<section id="{section}">' in drawn
    assert Page(drawn).tags.count("svg") == 7
    for words in ("AIC-VDS", "EOF", "WQCS", "Jain", "aicvds simulate", "stub-1", "seed 0"):
        assert words in drawn


def test_the_page_has_the_sources_of_the_decisions(flight: Flight, drawn: str) -> None:
    summary = summary_of(flight, None)
    assert policy_labels(summary)["aic_vds"] == "AIC-VDS: 8 onboard, 7 llm"
    notice = llm_notice(summary)
    assert notice is not None and "The LLM took 7 of 15 decisions" in notice and "policy_eof 15" in notice
    assert "AIC-VDS: 8 onboard, 7 llm" in drawn and "this is not a result of the LLM" in drawn
    assert "guided" not in drawn and "<td>value</td>" not in drawn
    by_llm = summary.by_source.model_copy(update={"llm": 14, "onboard": 1})
    assert llm_notice(summary.model_copy(update={"by_source": by_llm})) is None
    assert llm_notice(summary.model_copy(update={"mode": "value"})) is None


@pytest.mark.parametrize("mode", ["llm", "guided", "value", "policy"])
def test_no_page_predicts_what_its_table_contradicts(flight: Flight, figures_of: Drawn, mode: str) -> None:
    summary = summary_of(flight, "SmolLM2-135M-Instruct.Q8_0").model_copy(
        update={"mode": mode, "lost_packets": {"aic_vds": 8, "eof": 204}, "loss_events": {"aic_vds": 6, "eof": 50}}
    )
    html = render_report(summary, SHORT, flight.decisions, figures_of)
    assert "to lose more" not in html and "135 million" not in html
    assert ("depends on the LLM" in html) == (mode == "llm")


def test_the_page_has_the_bound(flight: Flight, figures_of: Drawn) -> None:
    bounded = summary_of(flight, None).model_copy(
        update={"lost_packets": {"aic_vds": 8}, "bound": LossBound(lower_bound=8, best_flight=8, seconds=1.0)}
    )
    html = render_report(bounded, SHORT, flight.decisions, figures_of)
    assert "Nobody can lose fewer than 8 packets in this world; this mission lost 8." in html
    assert "<td>nobody can lose fewer (clairvoyant bound)</td><td>8</td>" in html
    unknown = bounded.model_copy(update={"bound": None, "bound_missing": "the mission ended before its last step"})
    assert "loss is unknown: the mission ended" in render_report(unknown, SHORT, flight.decisions, figures_of)


def test_the_figures_follow_the_pages_theme(flight: Flight) -> None:
    inline = figures.losses({"eof": flight.tally}, {}).inline
    assert "#ffffff" not in inline and "#000000" not in inline and "var(--ink)" in inline


def test_decisions_of_learned_values_are_named_and_have_no_tokens(flight: Flight) -> None:
    learned = Flight(flight.scenario, 0, tally=flight.tally, sensor_xy=flight.sensor_xy)
    learned.decisions = [
        d.model_copy(update={"source": "value", "reason": "mode_value", "rtt_ms": 3.0}) for d in flight.decisions
    ]
    html = page(learned)
    assert "value: what the edge&#39;s modules learned" in html or "value: what the edge's modules learned" in html
    assert "<td>value</td><td>15</td>" in html and '<section id="tokens">' not in html


def test_a_local_policys_page_has_nothing_of_an_edge() -> None:
    flown = fly(Site(SHORT), LocalPilot("eof", SHORT, 0), seed=0)
    facts = flown.facts(
        policy="eof", edge=None, mission_id="m", mode=None, model=None, deadline_ms=None, command="c"
    )  # fmt: skip
    tallies = {"eof": flown.tally}
    summary = summarise(facts, flown.decisions, tallies)
    drawn = drawings(summary, SHORT, flown.decisions, tallies, flown.sensor_xy)
    html = render_report(summary, SHORT, flown.decisions, drawn)
    for absent in ("latency", "tokens", "deciders"):
        assert f'<section id="{absent}">' not in html
    assert "round trip" not in html and "<dt>edge</dt>" not in html and "135 million" not in html
    assert Page(html).tags.count("svg") == 2


def test_a_policy_has_one_colour_on_every_page(flight: Flight) -> None:
    alone = figures.losses({"eof": flight.tally}, {}).inline
    assert figures.POLICIES["eof"][0].lower() in alone and figures.POLICIES["aic_vds"][0].lower() not in alone


def test_the_costliest_decisions_come_first() -> None:
    flown = [decision(step=n, cost=float(n % 7)) for n in range(30)]
    shown = costliest(flown)
    assert len(shown) == 15 and [d.step for d in shown[:4]] == [6, 13, 20, 27]
    assert [d.step for d in costliest(flown[:9])] == [6, 5, 4, 3, 2, 1, 8]


def test_a_flight_without_costs_has_no_costly_decisions(flight: Flight, figures_of: Drawn) -> None:
    free, summary = [d.model_copy(update={"cost": 0.0}) for d in flight.decisions], summary_of(flight, "stub-1")
    assert "No decision cost anything" in render_report(summary, SHORT, free, figures_of)
    assert "No decision cost anything" not in render_report(summary, SHORT, flight.decisions, figures_of)


def test_the_page_needs_nothing_but_itself(drawn: str) -> None:
    parsed = Page(drawn)
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in parsed.loaded)
    assert not {"link", "img", "iframe"} & set(parsed.tags)
    # The browser too refuses every request, and every script but the page's own.
    assert re.search(r'Content-Security-Policy" content="default-src .none.;[^"]*script-src .sha256-[^ "]+"', drawn)
    assert "@import" not in drawn and "@font-face" not in drawn
    without_names = re.sub(r'xmlns(:\w+)?="[^"]*"', "", drawn).replace("http://edge:8000", "")
    assert not re.search(r"https?://", without_names)
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", drawn))


def test_the_figures_ids_do_not_collide_and_all_resolve(drawn: str) -> None:
    parsed = Page(drawn)
    assert len(parsed.ids) == len(set(parsed.ids))
    targets = [a[1:] for a in parsed.loaded if a.startswith("#")] + re.findall(r"url\(#([^)]*)\)", drawn)
    targets += re.findall(r'aria-labelledby="([^"]*)"', drawn)
    assert set(targets) <= set(parsed.ids)


def test_the_page_is_the_same_each_time(flight: Flight, drawn: str) -> None:
    assert page(flight) == drawn


def test_text_of_the_edge_is_escaped(flight: Flight) -> None:
    evil = [d.model_copy(update={"reason": EVIL}) for d in flight.decisions]
    html = page(flight, model=EVIL, decisions=evil)
    assert "<script>alert" not in html and html.count("<script") == 2
    assert html.count("&lt;script&gt;") >= 2


def test_a_flight_of_no_step_has_a_page() -> None:
    nothing = Flight(SHORT, 0, interrupted=True)
    html = page(nothing)
    assert "interrupted after step 0 of 5" in html


def test_a_large_fleet_fits() -> None:
    world = SCENARIOS["dense"].model_copy(update={"steps": 3})
    flown = fly(Site(world), LocalPilot("random", world, 0), seed=0)
    summary, tallies = summary_of(flown, None), {"a": flown.tally}
    drawn = drawings(summary, world, flown.decisions, tallies, np.zeros((100, 2)))
    assert "The first 9 of 10 UAVs are shown" in render_report(summary, world, flown.decisions, drawn)


def test_figures_are_written_for_print(tmp_path: Path) -> None:
    flown = fly(Site(SHORT), LocalPilot("random", SHORT, 0), seed=0)
    summary = summary_of(flown, None)
    write_report(
        tmp_path / "r.html", summary, SHORT, flown.decisions, {"aic_vds": flown.tally}, flown.sensor_xy, flown.track
    )
    html = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "seed 0" in html and "<code>aicvds simulate</code>" in html
    widths = {"losses": 7.16, "latency-map": 7.16, "visits": 3.5, "deciders": 3.5, "latency-steps": 3.5}
    for name, width in widths.items():
        assert f"figures/{name}.pdf" in html
        pdf, svg = ((tmp_path / "figures" / f"{name}.{kind}").read_bytes() for kind in ("pdf", "svg"))
        [box] = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) [\d.]+ \]", pdf)
        assert float(box) == pytest.approx(72 * width)
        assert b"/FontFile2" in pdf and b"<text" in svg
    # Drawn again, every byte is the same.
    for again in (figures.deciders(flown.decisions), figures.losses({"aic_vds": flown.tally}, policy_labels(summary))):
        for path in again.write(tmp_path):
            assert path.read_bytes() == (tmp_path / "figures" / path.name).read_bytes()


def test_names_are_in_tables_figures_and_playback_and_none_is_markup(flight: Flight, tmp_path: Path) -> None:
    names = Names(sensors=[EVIL, *(f"kp-{number}.5" for number in range(1, 10))], uavs=["north", None, EVIL])
    summary = summary_of(flight, None).model_copy(update={"names": names})
    costly = [decision(cost=2.0, sensor_id=sensor, uav_id=sensor) for sensor in range(3)]
    tallies = {"aic_vds": flight.tally}
    path = tmp_path / "report.html"
    write_report(path, summary, flight.scenario, costly, tallies, flight.sensor_xy, flight.track)
    text = path.read_text(encoding="utf-8")
    assert EVIL not in text and "&lt;script&gt;alert" in text
    assert 'data-label="UAV">north<' in text and 'data-label="sensor">kp-1.5' in text
    # A name is at most a dozen letters in a figure, and a UAV without one has its number.
    assert 'data-label="UAV">1<' in text
    assert re.search(r"<!-- kp-1\.5 -->|>kp-1\.5<", (tmp_path / "figures" / "visits.svg").read_text(encoding="utf-8"))
    played = json.loads(re.search(r'id="playback-data">(.*?)</script>', text)[1])  # type: ignore[index]
    assert played["names"]["sensors"][:2] == [EVIL, "kp-1.5"]


def test_a_world_without_names_has_ids(flight: Flight) -> None:
    assert 'data-label="sensor">0' in page(flight, decisions=[decision(cost=2.0)])
