"""Operator guidance: a fleet's orders in addition to its goal to lose no packets, in a form that code can check.

An operator writes a note in plain words, and an LLM compiles it to a :class:`Guidance`. The edge obeys only confirmed
guidance. Empty guidance changes no number anywhere.
"""

import operator
from collections.abc import Collection, Iterable, Mapping
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, Field, ValidationError, model_validator

from shared.wire.schemas import SensorId, Step
from shared.wire.strict_models import Received
from shared.world.channel import FloatArray
from shared.world.scenario import Scenario

Level = Annotated[int, Field(ge=0, le=14)]
MAX_WISHES = 1000
MAX_WEIGHT = 10.0
MAX_EVERY = 1000
# The cost in lost packets of each step in which a sensor is overdue. It is above the loss of the fullest sensor in one
# step, so that a deadline gives way only to several sensors that overflow.
LATE_PACKETS = 20.0


# The name of an order: a fleet has one order of each name in force.
OrderName = Annotated[str, Field(pattern=r"^((visit|weight):\d{1,9}|min_velocity|max_velocity|avoid:\d{1,2})$")]
Clock = Annotated[AwareDatetime, Field(strict=False)]


class End(Received):
    """The end of an order: at a step, after some steps, at a time of the edge's clock, or when a sensor was visited.

    An order whose end has come ends before the next decision.
    """

    step: Step | None = Field(None, description="the first step no longer under the order")
    steps: int | None = Field(None, ge=1, le=100_000, description="this many steps, from the beginning of the order on")
    time: Clock | None = Field(None, description="ISO 8601, with its offset from UTC")
    visited: SensorId | None = Field(None, description="a visit of this sensor that succeeded")

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if [self.step, self.steps, self.time, self.visited].count(None) != 3:
            raise ValueError("give one of step, steps, time and visited")
        return self

    def __str__(self) -> str:
        if self.step is not None or self.steps is not None:
            return f"for {self.steps} steps" if self.step is None else f"until step {self.step}"
        end = self.time.isoformat(" ", "minutes") if self.time else f"sensor {self.visited} was visited"
        return f"until {end}"


class SensorWish(Received):
    """The orders for one sensor.

    With ``visit_every`` n the fleet is to visit the sensor at least once in any n consecutive steps.
    """

    sensor_id: SensorId
    weight: float = Field(1.0, ge=0, le=MAX_WEIGHT, description="the factor of its lost packets; 0: they do not count")
    visit_every: int | None = Field(None, ge=1, le=MAX_EVERY, description="steps")


class Guidance(Received):
    """A fleet's orders: wishes for sensors, and forbidden velocities.

    The velocities, m/s, are a hard rule: a UAV flies none of ``forbidden_velocities`` and none outside
    ``min_velocity..max_velocity``. Weights and visits are weighed against each other and against lost packets.
    """

    sensors: list[SensorWish] = Field([], max_length=MAX_WISHES, fail_fast=True)
    min_velocity: Level | None = None
    max_velocity: Level | None = None
    forbidden_velocities: list[Level] = Field([], max_length=15, fail_fast=True)
    ends: dict[OrderName, End] = Field(
        {},
        exclude_if=operator.not_,
        description="the ends of orders, by their names: `visit:4`, `weight:4`, `min_velocity`, `max_velocity`, "
        "`avoid:0`; the other orders stay until they are withdrawn or replaced",
    )

    @classmethod
    def of(cls, values: Mapping[str, float], ends: Mapping[str, End]) -> Self:
        """The guidance of orders by name, as :attr:`values` has them; ends of other orders are left out.

        Raises:
            Impossible: a value is out of range, or more than 1,000 sensors have orders.
        """
        wishes: dict[int, dict[str, float]] = {}
        for name, value in values.items():
            kind, _, number = name.partition(":")
            if kind in ("visit", "weight"):
                wish = wishes.setdefault(int(number), {"sensor_id": int(number)})
                wish["weight" if kind == "weight" else "visit_every"] = value
        try:
            return cls.model_validate(
                {
                    "sensors": list(wishes.values()),
                    "forbidden_velocities": [value for name, value in values.items() if name.startswith("avoid:")],
                    "ends": {name: end for name, end in ends.items() if name in values},
                    **{name: value for name, value in values.items() if name.endswith("_velocity")},
                }
            )
        except ValidationError as error:
            first = error.errors()[0]
            raise Impossible(str(first["loc"][-1] if first["loc"] else "sensors"), first["msg"]) from None

    @property
    def values(self) -> dict[str, float]:
        """Each order's value by its name: steps, the factor of a weight, or m/s."""
        values: dict[str, float] = {}
        for wish in self.sensors:
            if wish.visit_every is not None:
                values[f"visit:{wish.sensor_id}"] = wish.visit_every
            if wish.weight != 1.0:
                values[f"weight:{wish.sensor_id}"] = wish.weight
        limits = {"min_velocity": self.min_velocity, "max_velocity": self.max_velocity}
        values |= {name: value for name, value in limits.items() if value is not None}
        return values | {f"avoid:{level}": level for level in sorted(self.forbidden_velocities)}

    @model_validator(mode="after")
    def _ends_of_orders(self) -> Self:
        if unknown := self.ends.keys() - self.values:
            raise ValueError(f"ends names {min(unknown)}, which is no order of this guidance")
        return self

    @model_validator(mode="after")
    def _each_sensor_once(self) -> Self:
        ids = [wish.sensor_id for wish in self.sensors]
        if len(set(ids)) < len(ids):
            raise ValueError(f"sensors names sensor {next(i for i in ids if ids.count(i) > 1)} more than once")
        return self

    def __bool__(self) -> bool:
        """Whether there is any order."""
        return self.wishes or self.restricts

    @property
    def wishes(self) -> bool:
        """Whether any sensor has a weight or a visit deadline."""
        return any(wish.weight != 1.0 or wish.visit_every is not None for wish in self.sensors)

    @property
    def restricts(self) -> bool:
        """Whether there is a rule on velocities, even one that forbids none of the scenario's."""
        return bool(self.forbidden_velocities) or self.min_velocity is not None or self.max_velocity is not None

    def check(self, scenario: Scenario) -> None:
        """Check that a fleet in this scenario can obey.

        Raises:
            Impossible: a sensor is unknown, a velocity does not exist, or no velocity is left.
        """
        for row, wish in enumerate(self.sensors):
            if wish.sensor_id >= scenario.sensors:
                known = f"there are {scenario.sensors}, from 0"
                raise Impossible(f"sensors[{row}].sensor_id", f"sensor {wish.sensor_id} is unknown: {known}")
        for name, end in self.ends.items():
            if end.visited is not None and end.visited >= scenario.sensors:
                raise Impossible(f"ends.{name}.visited", f"sensor {end.visited} is unknown")
        named = {"min_velocity": self.min_velocity, "max_velocity": self.max_velocity}
        named |= {f"forbidden_velocities[{row}]": level for row, level in enumerate(self.forbidden_velocities)}
        for name, level in named.items():
            if level is not None and level > scenario.max_velocity:
                raise Impossible(name, f"{level} m/s is more than the fleet's highest, {scenario.max_velocity} m/s")
        if not self.allowed(scenario.max_velocity + 1).any():
            raise Impossible("forbidden_velocities", "no velocity is left to fly at")

    def allowed(self, levels: int) -> NDArray[np.bool_]:
        """Which of the velocities 0..levels - 1 m/s a UAV may fly, shape ``(levels,)``."""
        level = np.arange(levels)
        fastest = levels if self.max_velocity is None else self.max_velocity
        slowest = 0 if self.min_velocity is None else self.min_velocity
        return (level >= slowest) & (level <= fastest) & ~np.isin(level, self.forbidden_velocities)

    def allows(self, velocity: int) -> bool:
        """Whether a UAV may fly this velocity."""
        slow = self.min_velocity is not None and velocity < self.min_velocity
        fast = self.max_velocity is not None and velocity > self.max_velocity
        return not (slow or fast or velocity in self.forbidden_velocities)

    def nearest(self, velocity: int, levels: int) -> int:
        """The allowed velocity of 0..levels - 1 nearest to this one, the slower of two."""
        if 0 <= velocity < levels and self.allows(velocity):
            return velocity
        choices = np.flatnonzero(self.allowed(levels))
        return int(choices[np.abs(choices - velocity).argmin()])

    def weights(self, sensors: int) -> FloatArray:
        """The factor of each sensor's lost packets, shape ``(J,)``."""
        weights = np.ones(sensors)
        for wish in self.sensors:
            weights[wish.sensor_id] = wish.weight
        return weights

    def visit_intervals(self, sensors: int) -> FloatArray:
        """The longest interval between visits to each sensor, steps, shape ``(J,)``; infinite without an order."""
        intervals = np.full(sensors, np.inf)
        for wish in self.sensors:
            if wish.visit_every is not None:
                intervals[wish.sensor_id] = wish.visit_every
        return intervals

    def overdue(self, step: int, visits: NDArray[np.int64]) -> FloatArray:
        """The steps by which each sensor is overdue if no UAV visits it in this step, shape ``(J,)``.

        It is 1 if a visit in this very step is just in time, and 0 if there is more time.

        Args:
            visits: step of the last visit, ``(J,)``; -1 for never, which counts as a visit just before step 0.
        """
        late: FloatArray = np.maximum(step - visits - self.visit_intervals(len(visits)) + 1.0, 0.0)
        return late

    def lateness(self, step: int, visits: NDArray[np.int64], horizon: int, beyond: int) -> FloatArray:
        """The price of overdue sensors in a plan from ``step`` on, packets: :attr:`FleetProblem.late`.

        ``late[s, e, j]`` is the price in the plan's step e if no UAV has visited sensor j since the plan's step s
        began; e = H stands for the ``beyond`` steps after the plan.

        Args:
            visits: step of the last visit before the plan, ``(J,)``; -1 for never.

        Returns:
            Shape ``(H + 1, H + 1, J)``.
        """
        late = np.zeros((horizon + 1, horizon + 1, len(visits)))
        for since in range(horizon + 1):
            last = visits if since == 0 else np.full_like(visits, step + since - 1)
            for now in range(since, horizon + 1):
                steps = [now] if now < horizon else range(horizon, horizon + beyond)
                late[since, now] = sum(LATE_PACKETS * (self.overdue(step + n, last) > 0) for n in steps)
        return late

    def lateness_beyond(
        self, step: int, visits: NDArray[np.int64], ways: NDArray[np.int64], counted: int
    ) -> FloatArray:
        """The price of visits that are made so many steps, ``ways`` ``(K,)``, from ``step`` on, ``(K, J)``, packets.

        It is above that of the ``counted`` steps which :meth:`lateness` counts after the plan.
        """
        due = visits + self.visit_intervals(len(visits)) - step
        late = [steps - np.clip(due, 0, steps) for steps in (*ways.tolist(), counted)]
        return np.asarray(LATE_PACKETS * (np.array(late[:-1]) - late[-1]))

    def merged_with(self, in_force: "Guidance", levels: int) -> "Guidance":
        """These orders merged with the orders in force.

        For a sensor in both, these orders apply. The allowed velocities are those of 0..levels - 1 m/s that both allow;
        if there are none, those that the orders in force allow.
        """
        if not in_force:
            return self
        named = {wish.sensor_id for wish in self.sensors}
        others = [wish for wish in in_force.sensors if wish.sensor_id not in named]
        allowed = in_force.allowed(levels)
        both = allowed & self.allowed(levels)
        forbidden = np.flatnonzero(~(both if both.any() else allowed)).tolist()
        return Guidance(sensors=[*self.sensors, *others][:MAX_WISHES], forbidden_velocities=forbidden)

    def without(self, names: Collection[str]) -> Self:
        """These orders without those of some names."""
        return self.of({name: value for name, value in self.values.items() if name not in names}, self.ends)

    def added_to(self, in_force: "Guidance", levels: int) -> "Guidance":
        """The orders in force and these: where two contradict each other, this guidance's.

        An order contradicts one of the same name, a visit that its sensor is ignored, and velocities each other if they
        leave none of 0..levels - 1 m/s.

        Raises:
            Impossible: more than 1,000 sensors have orders.
        """
        own, kept = self.values, in_force.values
        for name, value in own.items():
            kind, _, number = name.partition(":")
            if kind == "weight" and value == 0:
                kept.pop(f"visit:{number}", None)
            elif kind == "visit" and kept.get(f"weight:{number}") == 0:
                del kept[f"weight:{number}"]
        ends = {name: end for name, end in in_force.ends.items() if name not in own} | self.ends
        both = self.of(kept | own, ends)
        if not both.allowed(levels).any():
            velocities = [name for name in kept if name not in own and not name.startswith(("visit:", "weight:"))]
            fewer = [both.without([name]) for name in velocities]
            both = next((one for one in fewer if one.allowed(levels).any()), both.without(velocities))
        return both

    def in_words(self) -> str:
        """The orders in plain English, from the structure alone."""
        return " ".join(self.each_in_words().values()) or "Nothing beyond the mission's own rules."

    def beyond(self, other: "Guidance") -> list[str]:
        """The orders, each in words, that the other guidance does not have."""
        others = set(other.each_in_words().values())
        return [order for order in self.each_in_words().values() if order not in others]

    def each_in_words(self) -> dict[str, str]:
        """Each order in words, by its name."""
        words = {}
        for name, value in self.values.items():
            end = self.ends.get(name)
            text = _in_words(*name.split(":"), value=value)
            if once(name, value, end):
                text, end = f"Visit sensor {name[6:]} once, as soon as possible", None
            words[name] = f"{text}{'' if end is None else f', {end}'}."
        return words


def once(name: str, value: float, end: End | None) -> bool:
    """Whether an order is one visit: it is due in every step until it was made."""
    return end is not None and value == 1 and name == f"visit:{end.visited}"


def _in_words(kind: str, number: str = "", *, value: float) -> str:
    if kind == "visit":
        return f"Visit sensor {number} " + (
            "in every step" if value == 1 else f"at least once in every {value:g} steps"
        )
    if kind == "weight" and value == 0:
        return f"Ignore what sensor {number} loses"
    if kind == "weight":
        return f"Count each packet that sensor {number} loses {value:g} times"
    how = {"min_velocity": "slower than", "max_velocity": "faster than"}.get(kind, "at")
    return f"Never fly {how} {value:g} m/s"


def count_deadlines(interval: int, since: int, last: int, visited: Iterable[int]) -> tuple[int, int]:
    """The numbers of deadlines met and missed of one sensor from step ``since`` to step ``last``.

    A deadline ends in every step whose last ``interval`` steps all lie in that time: the first in ``since + interval -
    1``. It is met if one of these steps had a visit.

    Args:
        visited: the steps of the visits, in any order; others than those from ``since`` to ``last`` do not count.
    """
    first = since + interval - 1
    met, through = 0, first - 1
    for step in sorted(step for step in visited if since <= step <= last):
        until = min(step + interval - 1, last)
        met += max(0, until - max(step - 1, through))
        through = max(through, until)
    return met, max(0, last - first + 1) - met


class Impossible(ValueError):
    """Guidance that this fleet cannot obey; ``field`` is the field at fault."""

    def __init__(self, field: str, detail: str) -> None:
        super().__init__(f"{field}: {detail}")
        self.field = field
        self.detail = detail


NO_GUIDANCE = Guidance()
