"""A UAV's observation as a request to the edge."""

from shared.wire.schemas import DecideRequest, Outcome, SensorColumns
from shared.world.channel import FloatArray
from simulator.world.observation import Observation


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
    positions = observation["sensor_position"]

    def column(values: FloatArray) -> list[float | None]:
        return [value if step >= 0 else None for value, step in zip(values.tolist(), heard, strict=True)]

    return DecideRequest(
        mission_id=mission_id,
        uav_id=uav,
        step=int(observation["step"][0]),
        position=observation["position"].tolist(),
        progress_m=float(observation["progress"][0]),
        sensors=SensorColumns(
            id=list(range(len(heard))),
            x=positions[:, 0].tolist(),
            y=positions[:, 1].tolist(),
            queue=column(observation["queue"]),
            battery=column(observation["battery"]),
            channel_gain=column(observation["channel_gain"]),
            last_seen=[step if step >= 0 else None for step in heard],
        ),
        outcome=outcome,
        deadline_ms=deadline_ms,
    )
