"""Scenarios: every number of the world in one validated model, and the presets by name."""

import math
import tomllib
from importlib.resources import files
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from shared.kit.received_objects import few_names

Point = tuple[float, float]
Coordinate = Annotated[float, Field(ge=-1e7, le=1e7)]
Waypoint = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
MAX_SENSORS = 2_000
_MAX_ARRIVALS = 10_000_000


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


class Scenario(Unmodelled):
    """The parameters of one world. The defaults are the scenario ``paper``.

    Lengths are in metres, times in seconds unless a field says steps, powers in watts,
    energies in joules, path losses in dB (the channel gain is minus the path loss).
    The fields of :class:`shared.world.scenario.Unmodelled` are of this model too, and only the simulator reads them.

    Raises:
        pydantic.ValidationError: a field is out of bounds, or two fields contradict each other.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)
    _few_names = model_validator(mode="before")(few_names)

    name: str = Field("paper", pattern=r"^[a-z][a-z0-9_]{0,31}$")
    sensors: int = Field(10, ge=1, le=MAX_SENSORS, description="number of ground sensors J")
    uavs: int = Field(3, ge=1, le=100, description="number of UAVs I")
    steps: int = Field(30, ge=1, le=10_000, description="waypoints of a mission T")

    area_m: float = Field(1000.0, ge=1, le=1e6, description="side of the square area")
    layout: Literal["uniform", "pipeline", "surveyed"] = "uniform"
    sites: tuple[Annotated[Point, Field(strict=False)], ...] = Field(
        (),
        max_length=10_000,
        strict=False,
        fail_fast=True,
        description="sensor positions inside the area, one a sensor, of layout `surveyed`",
    )
    pipeline: tuple[Annotated[Point, Field(strict=False)], ...] = Field(
        ((50.0, 120.0), (350.0, 300.0), (500.0, 560.0), (720.0, 640.0), (950.0, 900.0)),
        max_length=1000,
        strict=False,
        fail_fast=True,
        description="polyline along which layout `pipeline` places the sensors, and which pictures of layout "
        "`surveyed` show; none: ()",
    )
    pipeline_spread_m: float = Field(20.0, ge=0, le=1e6, description="largest offset from the polyline, each axis")

    altitude_m: float = Field(100.0, ge=1, le=1e4)
    radio_radius_m: float = Field(360.0, ge=1, le=1e6, description="horizontal")
    step_s: float = Field(10.0, ge=0.01, le=3600)
    max_velocity: int = Field(14, ge=1, le=14, description="velocity levels are 0..max, in m/s")
    lap_radius_m: float = Field(300.0, ge=1, le=1e6)
    lap_offset_m: float = Field(250.0, ge=0, le=1e6, description="distance of the lap centres from the area's centre")
    routes: tuple[
        Annotated[tuple[Waypoint, ...], Field(strict=False, min_length=2, max_length=1000, fail_fast=True)], ...
    ] = Field(
        (),
        max_length=100,
        strict=False,
        fail_fast=True,
        description="waypoints of each UAV's trajectory, instead of laps; flown in laps if the last is the first, "
        "else there and back",
    )

    queue_capacity: int = Field(60, ge=1, le=100_000, description="packets, W")
    initial_queue_min: float = Field(0.3, ge=0, le=1, description="fraction of W")
    initial_queue_max: float = Field(1.0, ge=0, le=1, description="fraction of W")
    arrival_rate_min: float = Field(2.0, ge=0, le=1000, description="packets a step")
    arrival_rate_max: float = Field(8.0, ge=0, le=1000, description="packets a step")
    battery_j: float = Field(50.0, ge=1e-6, le=1e9)
    transmit_power_w: float = Field(0.1, ge=1e-6, le=1e3)

    los_a: float = Field(20.0, gt=0, le=100, description="Al-Hourani a, angles in degrees")
    los_kappa: float = Field(0.3, gt=0, le=5, description="Al-Hourani b, per degree")
    los_excess_db: float = Field(1.0, ge=0, le=100)
    nlos_excess_db: float = Field(20.0, ge=0, le=100)
    carrier_mhz: float = Field(2000.0, ge=1, le=1e6)
    path_loss_limit_db: float = Field(110.0, gt=0, le=400, description="h_th: the link fails at or past it")
    bandwidth_hz: float = Field(1e6, ge=1, le=1e12)
    noise_dbm_hz: float = Field(-174.0, ge=-300, le=0)
    noise_figure_db: float = Field(9.0, ge=0, le=100)
    spectral_cap: float = Field(6.0, ge=0.01, le=100, description="bit/s/Hz, 64-QAM")
    packet_bits: float = Field(1e6, ge=1, le=1e12)
    link_share: float = Field(1.0, ge=1e-6, le=1, description="share of the rate that a transfer gets")

    overflow_horizon_steps: float = Field(3.0, gt=0, le=100, description="expected steps to the next visit")
    uplink_drop: float = Field(0.0, ge=0, lt=1, description="share of requests lost on the way to the edge")
    uplink_jitter_ms: float = Field(0.0, ge=0, le=10_000, description="uniform extra delay of a request")

    @field_validator("pipeline")
    @classmethod
    def _no_lone_point(cls, pipeline: tuple[Point, ...]) -> tuple[Point, ...]:
        if len(pipeline) == 1:
            raise ValueError("a polyline of one point: give at least two, or none")
        return pipeline

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for name in ("arrival_rate", "initial_queue"):
            if getattr(self, f"{name}_min") > getattr(self, f"{name}_max"):
                raise ValueError(f"{name}_min exceeds {name}_max")
        if self.layout == "pipeline" and not self.pipeline:
            raise ValueError("layout pipeline needs a pipeline of at least two points")
        if self.layout == "surveyed" and len(self.sites) != self.sensors:
            raise ValueError(f"layout surveyed has {len(self.sites)} sites for {self.sensors} sensors")
        if self.sites and not all(0 <= value <= self.area_m for site in self.sites for value in site):
            raise ValueError(f"sites has a position outside the area of 0..{self.area_m:g} m")
        if self.routes and len(self.routes) != self.uavs:
            raise ValueError(f"routes has {len(self.routes)} trajectories for {self.uavs} UAVs")
        for uav, route in enumerate(self.routes):
            if len(set(route)) < 2:
                raise ValueError(f"routes[{uav}] needs at least two different waypoints")
        if self.dead_radios > self.sensors:
            raise ValueError(f"dead_radios is {self.dead_radios}, there are {self.sensors} sensors")
        if self.departures >= self.uavs:
            raise ValueError(f"departures is {self.departures} of {self.uavs} UAVs: at least one has to stay")
        if self.sensors * self.steps > _MAX_ARRIVALS:
            raise ValueError(f"sensors x steps exceeds {_MAX_ARRIVALS:,}: a world draws that many arrivals at once")
        return self

    def __hash__(self) -> int:
        # Of few fields: hashing each point of a large site takes as long as a decision.
        return hash((self.name, self.sensors, self.uavs, self.steps, self.sites[:1], self.routes and self.routes[0][0]))

    @property
    def lap_centres(self) -> tuple[Point, ...]:
        """Centre of each UAV's circle, metres: evenly spread around the area's centre, the first due north."""
        half = self.area_m / 2
        angles = (math.radians(90.0 + 360.0 * i / self.uavs) for i in range(self.uavs))
        return tuple((half + self.lap_offset_m * math.cos(a), half + self.lap_offset_m * math.sin(a)) for a in angles)

    @property
    def mean_arrival_rate(self) -> float:
        """The mean of the arrival rates' range, packets a step: the assumed rate of a sensor not yet observed."""
        return (self.arrival_rate_min + self.arrival_rate_max) / 2


_PRESETS = tomllib.loads(files("shared.world").joinpath("scenarios.toml").read_text(encoding="utf-8"))
SCENARIOS: dict[str, Scenario] = {name: Scenario(name=name, **fields) for name, fields in _PRESETS.items()}


def scenario_named(name: str) -> Scenario:
    """The preset of that name.

    Raises:
        ValueError: no preset has that name; the message lists the names.
    """
    try:
        return SCENARIOS[name]
    except KeyError:
        raise ValueError(f"unknown scenario {name[:32]!r}: choose one of {', '.join(SCENARIOS)}") from None
