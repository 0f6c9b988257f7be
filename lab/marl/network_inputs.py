"""An actor's input: features of one UAV's observation, and the mask of its choices.

Training calls the same function for many worlds at once as a mission for one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.channel import FloatArray, IntArray, packets_per_step
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory, trajectories

BoolArray = NDArray[np.bool_]

# A sensor's reach columns: after one step at these shares of full speed, and after these numbers of steps at full
# speed.
_SPEEDS = (0.0, 0.25, 0.5, 0.75, 1.0)
_STEPS_AHEAD = (2, 3, 4, 6, 8)
_STATE_COLUMNS = 7
# Larger ages are clipped to this.
_OLD_STEPS = 20
_AGE_UNIT_STEPS = 10.0


class ActorInput(NamedTuple):
    """An actor's input from one UAV's observation; leading dimensions are those of the observation.

    Attributes:
        features: ``(..., F)``; the sensors are in the order of the slots.
        mask: ``(..., J + V)``, the slots and velocities allowed.
        order: ``(..., J)``, the sensor in each slot.
    """

    features: NDArray[np.float32]
    mask: BoolArray
    order: IntArray


def width(scenario: Scenario) -> int:
    """F, the length of the features."""
    columns = _STATE_COLUMNS + len(_SPEEDS) + len(_STEPS_AHEAD)
    return 3 + scenario.uavs + scenario.max_velocity + 1 + columns * scenario.sensors


def actor_input(scenario: Scenario, uav: int, observation: Mapping[str, Any]) -> ActorInput:
    """Features, mask and slot order from a UAV's ``Observation``.

    Features of the UAV: the share of the mission flown, the cosine and sine of the phase of its lap, a one-hot of its
    index, and for each velocity the largest expected yield of one sensor after a step. Features of each sensor: whether
    it was ever heard and is heard now; the expected queue as a share of W (the queue last heard plus the scenario's
    mean arrivals since, or the mean initial queue of a sensor never heard) and its age; the battery; the position
    relative to the UAV along and across its flight; and the packets that could be moved after a step at five velocities
    and after several steps at full speed, as shares of the most at no distance.

    Slots are in descending order of the expected yield after the best next step, equals by distance. Without this
    order, each slot would have to learn the same from a tenth of the data. Sensors never heard are masked, unless all
    are.

    Args:
        observation: of one UAV, or of that UAV in many worlds: arrays with more leading dimensions.
    """
    path = trajectories(scenario)[uav]
    step, progress = np.asarray(observation["step"]), np.asarray(observation["progress"])
    last_heard = np.asarray(observation["last_heard"])
    heard = last_heard >= 0
    ahead = path.at(progress + _ahead_m(scenario))
    offset = np.asarray(observation["sensor_position"])[..., :, None, :] - ahead[..., None, :, :]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    movable = packets_per_step(distance, scenario) / max(1, int(packets_per_step(0.0, scenario)))
    expected = _expected_queue(scenario, observation, step - last_heard, heard)
    age = np.where(heard, step - last_heard, _OLD_STEPS)
    along, across = _in_flight(path, progress, offset[..., 0, :])
    columns = (
        heard,
        last_heard == step,
        expected,
        np.minimum(age, _OLD_STEPS) / _AGE_UNIT_STEPS,
        np.where(heard, np.asarray(observation["battery"]) / scenario.battery_j, 1.0),
        along / scenario.radio_radius_m,
        across / scenario.radio_radius_m,
    )
    reach = _reach_columns(scenario)
    sensors = np.concatenate((np.stack(columns, axis=-1), movable[..., reach]), axis=-1)
    worth = expected[..., None] * movable[..., : scenario.max_velocity + 1]
    nearer = 1e-4 * distance[..., 0] / scenario.radio_radius_m
    order = np.argsort(nearer - worth.max(axis=-1), axis=-1, kind="stable")
    sensors = np.take_along_axis(sensors, order[..., None], axis=-2)
    uav_features = _uav_features(scenario, uav, step, 2.0 * np.pi * progress / path.length_m)
    parts = (uav_features, worth.max(axis=-2), sensors.reshape(*order.shape[:-1], -1))
    features = np.concatenate(parts, axis=-1).astype(np.float32)
    selectable = np.take_along_axis(heard | ~heard.any(axis=-1, keepdims=True), order, axis=-1)
    velocities = np.ones((*order.shape[:-1], scenario.max_velocity + 1), dtype=np.bool_)
    return ActorInput(features, np.concatenate((selectable, velocities), axis=-1), order)


def fleet_input(scenario: Scenario, observation: Mapping[str, Any]) -> ActorInput:
    """The views of a whole fleet, from arrays ``(B, I, ...)`` to arrays ``(B, I, ...)``."""
    fleet = range(scenario.uavs)
    views = [actor_input(scenario, uav, uav_slice(observation, uav)) for uav in fleet]
    return ActorInput(*(np.stack(parts, axis=1) for parts in zip(*views, strict=True)))


def uav_slice(observation: Mapping[str, Any], uav: int) -> dict[str, Any]:
    """One UAV's part of arrays ``(B, I, ...)``: arrays ``(B, ...)``."""
    return {key: value[:, uav] for key, value in observation.items()}


def mask_without(own: ActorInput, taken: BoolArray) -> BoolArray:
    """The mask without the sensors taken by other UAVs; if no slot remains, all free sensors; without those, all.

    Args:
        taken: by sensor, ``(..., J)``.
    """
    free = ~np.take_along_axis(taken, own.order, axis=-1)
    count = own.order.shape[-1]
    slots = own.mask[..., :count] & free
    slots = np.where(slots.any(axis=-1, keepdims=True), slots, free)
    slots = slots | ~slots.any(axis=-1, keepdims=True)
    return np.concatenate((slots, own.mask[..., count:]), axis=-1)


def taken_mask(taken: Collection[int], sensors: int) -> BoolArray:
    """The mask of the sensors in the collection, ``(J,)``."""
    return np.isin(np.arange(sensors), list(taken))


def _ahead_m(scenario: Scenario) -> FloatArray:
    """The distances ahead at which the reach is computed: one step at each velocity, then several at full speed."""
    steps = [*range(scenario.max_velocity + 1), *(scenario.max_velocity * n for n in _STEPS_AHEAD)]
    return np.array(steps) * scenario.step_s


def _reach_columns(scenario: Scenario) -> list[int]:
    """The indices of the distances that are features of every sensor."""
    top = scenario.max_velocity
    return [*(round(share * top) for share in _SPEEDS), *range(top + 1, top + 1 + len(_STEPS_AHEAD))]


def _expected_queue(scenario: Scenario, observation: Mapping[str, Any], age: IntArray, heard: BoolArray) -> FloatArray:
    """The expected queues, as shares of W."""
    capacity = scenario.queue_capacity
    mean_initial = (scenario.initial_queue_min + scenario.initial_queue_max) / 2.0 * capacity
    last = np.where(heard, observation["queue"], mean_initial)
    # Of a sensor never heard, last_heard is -1, so its age is one more than the steps flown.
    steps = np.where(heard, age, age - 1)
    return np.asarray(np.minimum(last + steps * scenario.mean_arrival_rate, capacity) / capacity)


def _in_flight(path: Trajectory, progress: FloatArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets ``(..., J, 2)`` from the UAV, along its direction of flight and to the left of it, metres."""
    forward = path.at(progress + 1.0) - path.at(progress)
    length = np.maximum(np.hypot(forward[..., 0], forward[..., 1]), 1e-9)
    x, y = forward[..., 0] / length, forward[..., 1] / length
    return offset[..., 0] * x + offset[..., 1] * y, offset[..., 1] * x - offset[..., 0] * y


def _uav_features(scenario: Scenario, uav: int, step: ArrayLike, phase: FloatArray) -> FloatArray:
    one_hot = np.zeros((*phase.shape[:-1], scenario.uavs))
    one_hot[..., uav] = 1.0
    return np.concatenate((np.asarray(step) / scenario.steps, np.cos(phase), np.sin(phase), one_hot), axis=-1)
