import numpy as np
import pytest

from shared.wire.schemas import SensorColumns
from shared.wire.sensor_arrays import arrays_of


def columns() -> SensorColumns:
    return SensorColumns(
        id=[4, 2],
        x=[1.0, 2.0],
        y=[3.0, 4.0],
        queue=[5.0, None],
        battery=[6.0, None],
        channel_gain=[-90.0, None],
        last_seen=[7, None],
    )


def test_a_sensor_never_heard_has_zeros_and_no_step() -> None:
    arrays = arrays_of(columns())
    assert arrays.ids.tolist() == [4, 2]
    assert arrays.places.tolist() == [[1, 3], [2, 4]]
    assert (arrays.queue.tolist(), arrays.battery.tolist(), arrays.gain.tolist()) == ([5, 0], [6, 0], [-90, 0])
    assert arrays.beacon.tolist() == [7, -1]


def test_they_are_made_once_and_change_neither_the_wire_nor_what_equals() -> None:
    sensors = columns()
    assert arrays_of(sensors) is arrays_of(sensors)
    other = columns()
    arrays_of(other)
    assert sensors == other == columns()
    assert sensors.model_dump_json() == columns().model_dump_json()
    assert SensorColumns.model_validate_json(sensors.model_dump_json()) == sensors


def test_nothing_can_change_them() -> None:
    with pytest.raises(ValueError, match="read-only"):
        arrays_of(columns()).gain[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        np.add(arrays_of(columns()).places, 1.0, out=arrays_of(columns()).places)
