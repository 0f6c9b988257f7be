"""How a world differs from the model that the edge plans with: fields of a scenario that only the simulator reads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import BaseModel, Field


def _equal(off: Any) -> Callable[[Any], bool]:
    """Whether a value is the one that a scenario's JSON leaves out.

    An edge of a version without the field then accepts every scenario that does not use it.
    """
    return lambda value: bool(value == off)


def _off(value: Any, **bounds: Any) -> Any:
    return Field(value, exclude_if=_equal(value), **bounds)


class Unmodelled(BaseModel):
    """What the mean path loss, steady Poisson arrivals and ``velocity x step_s`` leave out; by default nothing.

    The edge receives these fields with the scenario and must not read them: it has to learn from beacons, outcomes and
    positions what they do.
    """

    shadowing_db: float = _off(
        0.0,
        ge=0,
        le=30,
        description="standard deviation of a sensor's own excess loss, normal in dB, the same for the whole mission "
        "(3GPP TR 38.901 and TR 36.777: log-normal shadowing of 4 to 8 dB)",
    )
    route_shadowing_db: float = _off(
        0.0,
        ge=0,
        le=30,
        description="standard deviation of the excess loss that changes with the UAV's place, normal in dB, of each "
        "sensor another; the same place has the same loss again (Gudmundson, Electronics Letters 27(23), 1991)",
    )
    decorrelation_m: float = _off(
        50.0,
        ge=1,
        le=1e5,
        description="metres between two places at which the correlation of `route_shadowing_db` is 1/e "
        "(Gudmundson 1991; 3GPP TR 38.901 table 7.5-6: 10 to 120 m)",
    )
    dead_radios: int = _off(
        0,
        ge=0,
        le=10_000,
        description="number of sensors whose radio dies, each at the start of a step drawn from the whole mission: its "
        "beacons go on, and every transmission fails",
    )
