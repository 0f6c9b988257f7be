"""Differences of a world from the edge's planning model: fields of a scenario that only the simulator reads."""

from typing import Any, Literal

from pydantic import BaseModel, Field


def _off(value: Any, **bounds: Any) -> Any:
    """A field that a scenario's JSON omits at this value, so that an edge of a version without the field accepts it."""
    return Field(value, exclude_if=lambda given: bool(given == value), **bounds)


class Unmodelled(BaseModel):
    """Deviations from mean path loss, steady Poisson arrivals, ``velocity x step_s`` and beacons; none by default.

    The edge receives these fields with the scenario and must not read them: it has to learn their effects from beacons,
    outcomes and positions.
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
    rician_k_db: float | None = _off(
        None,
        ge=-40,
        le=40,
        description="Rician K factor, dB, of small-scale fading, drawn anew for each link and step with mean power 1; "
        "-40 is Rayleigh fading in effect, null no fading (measured air-to-ground values: survey arXiv 1801.01656)",
    )
    position_noise_m: float = _off(
        0.0,
        ge=0,
        le=1000,
        description="standard deviation of a reported position's error on each axis, cut at 5 of them; the reported "
        "progress is true (GPS SPS Performance Standard 2020: horizontal error at most 8 m in 95% of all cases)",
    )

    burst_factor: float = _off(
        1.0,
        ge=1,
        le=100,
        description="a sensor's arrival rate in a burst over its rate between bursts; its mean rate stays. Arrivals "
        "are a two-state Markov-modulated Poisson process (Fischer and Meier-Hellstern, 1993)",
    )
    burst_steps: float = _off(4.0, ge=1, le=10_000, description="mean length of a burst, geometric")
    calm_steps: float = _off(12.0, ge=1, le=10_000, description="mean steps from a burst to the next, geometric")

    wind_mps: float = _off(
        0.0,
        ge=0,
        le=50,
        description="mean wind. A UAV covers `velocity x step_s` times 1 + (wind along its way) / `max_velocity`, at "
        "least 0 and at most twice as much: at rest it holds its place, at full speed it has nothing left to resist",
    )
    wind_from_deg: float = _off(
        270.0, ge=0, le=360, description="where the wind comes from, degrees clockwise from north (the y axis)"
    )
    gust_mps: float = _off(
        0.0,
        ge=0,
        le=50,
        description="standard deviation of the wind along a UAV's way around its mean, normal, drawn anew for each UAV "
        "and step (MIL-F-8785C, low altitude: vertical turbulence of a tenth of the wind, horizontal more)",
    )

    observation_model: Literal["beacons", "served"] = _off(
        "beacons",
        description="what a UAV observes: the beacons of every sensor in radio range, or as in the paper's protocol "
        "only the status of the sensor that it served in the step",
    )
    dead_radios: int = _off(
        0,
        ge=0,
        le=10_000,
        description="number of sensors whose radio dies, each at the start of a step drawn from the whole mission: its "
        "beacons go on, and every transmission fails",
    )
    departures: int = _off(
        0,
        ge=0,
        le=100,
        description="number of UAVs that leave for good, each after a number of steps drawn from 1 to T - 1",
    )
    link_share_drop: float = _off(
        0.0,
        ge=0,
        lt=1,
        description="share of every link's rate that is lost from a step on, drawn from the mission's middle half",
    )
