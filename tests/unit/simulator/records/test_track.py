from __future__ import annotations

import numpy as np
import pytest

from simulator.records import track
from simulator.records.track import Instant, Track


def instant(step: int, sensors: int = 10) -> Instant:
    none = np.zeros(sensors, dtype=np.int64)
    return Instant(step, {0: (1.0, 2.0)}, none, none.astype(float), none)


def steps(tracked: Track, until: int) -> list[int]:
    return [one.step for one in tracked.until(until)]


def test_a_short_flight_is_kept_whole() -> None:
    tracked = Track()
    for step in range(31):
        tracked.append(instant(step))
    assert steps(tracked, 30) == list(range(31)) and tracked.stride == 1
    assert steps(tracked, 12) == list(range(13))


@pytest.mark.parametrize("flown", [1, 63, 64, 500, 999])
def test_a_long_flight_keeps_every_so_manieth_step_and_its_last(monkeypatch: pytest.MonkeyPatch, flown: int) -> None:
    monkeypatch.setattr(track, "MOST_NUMBERS", 400)
    tracked = Track()
    for step in range(flown + 1):
        tracked.append(instant(step))
        assert len(steps(tracked, step)) * 40 <= 400 + 40
    kept = steps(tracked, flown)
    assert kept[0] == 0 and kept[-1] == flown
    assert set(np.diff(kept[:-1])) <= {tracked.stride}
    assert len(kept) > 5 or tracked.stride == 1


def test_even_the_largest_world_keeps_its_start_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track, "MOST_NUMBERS", 10)
    tracked = Track()
    for step in range(10):
        tracked.append(instant(step))
    assert steps(tracked, 9)[0] == 0 and steps(tracked, 9)[-1] == 9 and len(steps(tracked, 9)) <= 3
