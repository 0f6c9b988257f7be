"""A report in the journal."""

from __future__ import annotations

import pytest

from service.mission.events import Reported
from service.storage.rows import decode, encode, pack
from shared.wire.schemas import UavState
from tests.support.half_heard import COLUMNS

REPORT = {"uav_id": 1, "position": [1.0, 2.0], "progress_m": 7.5, "top_speed_mps": 9.0, "sensors": COLUMNS}


def test_a_report_is_read_as_it_was_written() -> None:
    uav = UavState.model_validate(REPORT)
    assert decode(*encode(Reported(2, uav))) == Reported(2, uav)


def test_a_report_of_version_0_1_0_is_read() -> None:
    assert decode("reported", pack([2, REPORT])) == Reported(2, UavState.model_validate(REPORT))


@pytest.mark.parametrize("damaged", [{"arrays": [1, 2]}, {"arrays": 5}, {}])
def test_a_damaged_report_is_refused(damaged: dict[str, object]) -> None:
    body = {name: value for name, value in REPORT.items() if name != "sensors"} | damaged
    with pytest.raises(ValueError, match="damaged|sensors"):
        decode("reported", pack([2, body]))
