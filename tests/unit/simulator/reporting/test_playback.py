"""What the playback embeds is what the flight's records say."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import pytest

from shared.world.scenario import SCENARIOS
from simulator.flying.flight import fly
from simulator.flying.pilots import LocalPilot
from simulator.records import track
from simulator.records.flight import Flight
from simulator.reporting.html_report import playback
from simulator.sites.site import Site


def flown(name: str, steps: int) -> Flight:
    scenario = SCENARIOS[name].model_copy(update={"steps": steps})
    return fly(Site(scenario), LocalPilot("eof", scenario, 3), seed=3)


def mission_of(flight: Flight) -> dict[str, Any]:
    instants = flight.track.until(flight.steps_flown)
    played = playback(flight.scenario, flight.sensor_xy, flight.decisions, instants, flight.track.stride)
    assert played is not None
    return played.mission


@pytest.mark.parametrize("name", ["paper", "stress", "faulty", "windy"])
def test_frames_agree_with_decisions_and_tally(name: str) -> None:
    flight = flown(name, 12)
    frames = mission_of(flight)["frames"]
    assert [frame["step"] for frame in frames] == list(range(13))
    by_step = defaultdict(list)
    for d in flight.decisions:
        by_step[d.step].append(d)
    for frame, after, tally in zip(frames, frames[1:], flight.tally, strict=False):
        decided = by_step[frame["step"]]
        assert [one[:4] for one in frame["decisions"]] == [
            [d.uav_id, d.sensor_id, d.velocity, d.source] for d in decided
        ]
        assert [one[4:7] for one in frame["decisions"]] == [
            [int(d.failed), d.collected, d.lost_packets] for d in decided
        ]
        places = {uav: (x, y) for uav, x, y in frame["uavs"]}
        assert all(places[d.uav_id] == pytest.approx(d.position, abs=0.06) for d in decided)
        assert sum(after["lost"]) - sum(frame["lost"]) == tally.lost_packets
        lost_at = sum(late > early for late, early in zip(after["lost"], frame["lost"], strict=True))
        assert lost_at == tally.overflows
        assert sum(one[5] for one in frame["decisions"]) == tally.collected.sum()
    assert frames[-1]["decisions"] == []
    assert sum(frames[-1]["lost"]) == sum(t.lost_packets for t in flight.tally) > 0
    assert all(0 <= queue <= 60 for frame in frames for queue in frame["queue"])


def test_a_uav_that_left_is_in_no_later_frame() -> None:
    flight = flown("field", 30)
    there = [{one[0] for one in frame["uavs"]} for frame in mission_of(flight)["frames"]]
    deciding = [{d.uav_id for d in flight.decisions if d.step == step} for step in range(30)]
    assert len(deciding[0]) > len(deciding[-1])
    assert there[:-1] == deciding


def test_a_long_mission_shows_some_of_its_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track, "MOST_NUMBERS", 500)
    flight = flown("paper", 30)
    frames = mission_of(flight)["frames"]
    assert flight.track.stride == 4 and [frame["step"] for frame in frames] == [*range(0, 29, 4), 30]
    assert sum(frames[-1]["lost"]) == sum(t.lost_packets for t in flight.tally)


def test_a_mission_without_a_step_has_no_playback() -> None:
    flight = flown("paper", 3)
    start = flight.track.until(0)
    assert playback(flight.scenario, flight.sensor_xy, flight.decisions, start, 1) is None
