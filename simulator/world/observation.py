"""A UAV's observation of the world, its request to the edge, and the result of a step of the fleet."""

from dataclasses import dataclass
from typing import Any, TypedDict

from shared.wire.schemas import DecideRequest, Outcome, SensorColumns
from shared.world.channel import FloatArray, IntArray


class Observation(TypedDict):
    """The observation of one UAV; shapes and units are in :class:`~simulator.world.environment.PipelineWorld`."""

    step: IntArray
    position: FloatArray
    progress: FloatArray
    sensor_position: FloatArray
    queue: FloatArray
    battery: FloatArray
    channel_gain: FloatArray
    last_heard: IntArray


class Info(TypedDict):
    """The outcome of one UAV's last action; see :class:`~simulator.world.environment.PipelineWorld`."""

    failed: bool
    collected: int
    lost_packets: int
    cost: float


@dataclass(frozen=True, eq=False)
class StepTally:
    """One step of the whole fleet: the two losses of the paper's P_l, the packets lost, and those collected.

    ``failures`` is the sum of f over UAVs, ``overflows`` the sum of g over sensors, ``collected`` has shape ``(J,)``.
    """

    step: int
    failures: int
    overflows: int
    lost_packets: int
    collected: IntArray

    @property
    def events(self) -> int:
        """The paper's loss P_l of the step: failed transmissions plus overflowing sensors."""
        return self.failures + self.overflows


def decide_request(
    uav: int,
    observation: Observation,
    mission_id: str,
    *,
    deadline_ms: int | None = None,
    outcome: Outcome | None = None,
) -> DecideRequest:
    """One UAV's request: its observation as columns, ``null`` for sensors that it never heard.

    Raises:
        pydantic.ValidationError: the observation breaks a bound of the wire.
    """
    heard = observation["last_heard"].tolist()
    x, y = observation["sensor_position"].T.tolist()

    def column(values: FloatArray) -> list[float | None]:
        return [value if step >= 0 else None for value, step in zip(values.tolist(), heard, strict=True)]

    columns: dict[str, Any] = {name: column(observation[name]) for name in ("queue", "battery", "channel_gain")}
    seen = [step if step >= 0 else None for step in heard]
    return DecideRequest(
        mission_id=mission_id,
        uav_id=uav,
        step=int(observation["step"][0]),
        position=observation["position"].tolist(),
        progress_m=float(observation["progress"][0]),
        sensors=SensorColumns(id=[*range(len(heard))], x=x, y=y, **columns, last_seen=seen),
        outcome=outcome,
        deadline_ms=deadline_ms,
    )
