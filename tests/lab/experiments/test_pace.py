"""The estimate of the remaining time, by kind of flight, from measured durations."""

from __future__ import annotations

import pytest

from lab.experiments.pace import Pace, duration_text
from lab.experiments.plan import Planned, plan
from lab.experiments.schemes import llm, local, value
from simulator.sites.site import Site
from tests.support.tiny_flights import TINY, declared, setup


def flights() -> list[Planned]:
    return plan(declared(local("eof"), value()), setup()).flights


def test_measured_durations_replace_the_estimate() -> None:
    pace, (measured, *rest) = Pace(), flights()
    pace.took(measured, 9.0)
    same = [flight for flight in rest if flight.scheme.name == "eof"]
    assert pace.left_s(same) == pytest.approx(9.0 * len(same))
    assert pace.left_s([]) == 0


def test_an_llms_flight_is_taken_for_a_long_one_before_any_was_flown() -> None:
    [asking, *_] = plan(declared(llm(), references=("llm",)), setup(llm=setup().llm.__class__())).flights
    assert Pace().left_s([asking]) > 10 * Pace().left_s(flights()[:1])


def test_longer_missions_take_longer() -> None:
    pace, short = Pace(), flights()[0]
    long = Planned("key", short.scheme, "long", Site(TINY.model_copy(update={"steps": 30})), 0)
    pace.took(short, 1.0)
    assert pace.left_s([long]) == pytest.approx(10.0)


@pytest.mark.parametrize(("seconds", "words"), [(0.2, "0 s"), (89, "89 s"), (600, "10 min"), (12_000, "3 h 20 min")])
def test_durations_in_words(seconds: float, words: str) -> None:
    assert duration_text(seconds) == words
