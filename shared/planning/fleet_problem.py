"""The problem of planning for a fleet, and the course of the sensors' queues under a plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.planning.queue_chains import QueueChains
from shared.world.channel import FloatArray, IntArray, link_holds, packets_per_step, rate_bps
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class FleetProblem:
    """A fleet, its sensors, and the arrivals over a horizon of H steps.

    Attributes:
        scenario: the physics: channel, velocities, step, queue capacity W, transmit power.
        trajectories: one for each of the I UAVs.
        progress_m: shape ``(I,)``, each UAV's progress along its trajectory.
        places: shape ``(J, 2)``, metres.
        queue: shape ``(J,)``, whole packets, 0..W.
        battery: shape ``(J,)``, joules.
        arrivals: shape ``(H, J)``, whole packets that arrive in each step, after the transfers.
        fixed: by UAV, its first actions ``(n, 2)`` (sensor, velocity), n at most H, which begin every plan.
        usable: shape ``(H, J)``, whether a plan may serve a sensor in a step; ``None``: always. Fixed actions need not
            obey it.
        allowed: shape ``(V,)``, whether a plan may fly each velocity 0..V - 1; ``None``: all. Fixed actions need not
            obey it.
        weights: shape ``(J,)``, the factor of each sensor's lost packets; ``None``: 1.
        late: shape ``(H + 1, H + 1, J)``: ``late[s, e]`` is the price in packets, beside its losses, of each sensor's
            lateness in step e (H stands for all later steps) if no UAV has visited it since step s began; s = 0 means
            before the plan. Only s <= e counts. Never less for an earlier s. ``None``: 0.
        links: by UAV, shape ``(1, C, J)`` or, if they change by the step, ``(H, C, J)``: the whole packets that a step
            can move over the link after steps whose velocities sum to c, 0 where the link fails, with C at least
            ``H max_velocity + 1``. ``None``: by the formula.
        chances: of the same shapes as ``links``: the probability that each link holds. ``None``: 1.
        chains: the queues' distributions, by which a search prices its plans; the last sensor is then one nowhere.
            ``None``: a plan is priced by ``queue`` and ``arrivals``.
        stages: by UAV, shape ``(C, J)``: after velocities that sum to c, the stage of ``chains`` whose losses after the
            horizon count, higher the more steps the UAV needs to each sensor. The lowest of all UAVs counts. ``None``:
            the first one.

    Raises:
        ValueError: a shape or a value is wrong; the message names the field.
    """

    scenario: Scenario
    trajectories: Sequence[Trajectory]
    progress_m: FloatArray
    places: FloatArray
    queue: IntArray
    battery: FloatArray
    arrivals: IntArray
    fixed: Mapping[int, IntArray] = field(default_factory=dict)
    usable: NDArray[np.bool_] | None = None
    allowed: NDArray[np.bool_] | None = None
    weights: FloatArray | None = None
    late: FloatArray | None = None
    links: Sequence[IntArray] | None = None
    chances: Sequence[FloatArray] | None = None
    chains: QueueChains | None = None
    stages: Sequence[IntArray] | None = None

    def __post_init__(self) -> None:
        count = len(self.places)
        if self.arrivals.ndim != 2 or not len(self.arrivals):
            raise ValueError(f"arrivals has shape {self.arrivals.shape}, must be (H, {count}) with H at least 1")
        shapes = {
            "progress_m": (len(self.trajectories),),
            "places": (count, 2),
            "queue": (count,),
            "battery": (count,),
            "arrivals": (self.horizon, count),
        }
        if self.usable is not None:
            shapes["usable"] = (self.horizon, count)
        if self.allowed is not None:
            shapes["allowed"] = (self.scenario.max_velocity + 1,)
        if self.weights is not None:
            shapes["weights"] = (count,)
        if self.late is not None:
            shapes["late"] = (self.horizon + 1, self.horizon + 1, count)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, must be {shape}")
        for name in ("queue", "arrivals"):
            if getattr(self, name).dtype.kind not in "iu" or getattr(self, name).min(initial=0) < 0:
                raise ValueError(f"{name} must be whole packets, at least 0")
        if self.queue.max(initial=0) > self.scenario.queue_capacity:
            raise ValueError(f"queue has {self.queue.max()} packets, the capacity is {self.scenario.queue_capacity}")
        if self.allowed is not None and not self.allowed.any():
            raise ValueError("allowed has no velocity")
        self._check_links(count)
        self._check_stages(count)
        for uav, actions in self.fixed.items():
            if not 0 <= uav < self.uavs or actions.ndim != 2 or actions.shape[1] != 2 or len(actions) > self.horizon:
                shape = actions.shape
                raise ValueError(f"fixed[{uav}] has shape {shape}, must be (at most {self.horizon}, 2) of a UAV")

    def _check_links(self, count: int) -> None:
        sums = self.horizon * self.scenario.max_velocity + 1
        for uav, table in enumerate(self.links or ()):
            if (
                table.ndim != 3
                or len(table) not in (1, self.horizon)
                or table.shape[1] < sums
                or table.shape[2] != count
            ):
                raise ValueError(
                    f"links[{uav}] has shape {table.shape}, must be (1 or {self.horizon}, {sums}, {count})"
                )
        if self.links is not None and len(self.links) != self.uavs:
            raise ValueError(f"links has tables of {len(self.links)} UAVs, there are {self.uavs}")
        if any(table.dtype.kind not in "iu" or table.min(initial=0) < 0 for table in self.links or ()):
            raise ValueError("links must be whole packets, at least 0")
        if self.chances is not None and [c.shape for c in self.chances] != [table.shape for table in self.links or ()]:
            raise ValueError(f"chances has shapes {[c.shape for c in self.chances]}, must have those of links")
        if not all(((chance >= 0) & (chance <= 1)).all() for chance in self.chances or ()):
            raise ValueError("chances must be probabilities, 0..1")

    def _check_stages(self, count: int) -> None:
        if self.stages is None:
            return
        if self.chains is None:
            raise ValueError("stages needs chains")
        most, sums = len(self.chains.after), self.horizon * self.scenario.max_velocity + 1
        if len(self.stages) != self.uavs:
            raise ValueError(f"stages has tables of {len(self.stages)} UAVs, there are {self.uavs}")
        for uav, table in enumerate(self.stages):
            if table.shape != (sums, count):
                raise ValueError(f"stages[{uav}] has shape {table.shape}, must be ({sums}, {count})")
            if table.min() < 0 or table.max() >= most:
                raise ValueError(f"stages[{uav}] must be stages, 0..{most - 1}")

    @property
    def horizon(self) -> int:
        """Steps H."""
        return len(self.arrivals)

    @property
    def uavs(self) -> int:
        """UAVs I."""
        return len(self.trajectories)

    @property
    def sensors(self) -> int:
        """Sensors J."""
        return len(self.places)

    @property
    def levels(self) -> IntArray:
        """The velocities that a plan may fly, slowest first."""
        every = np.arange(self.scenario.max_velocity + 1)
        return every if self.allowed is None else every[self.allowed]

    def distance(self, uav: int, velocity: IntArray) -> FloatArray:
        """Horizontal distances to all sensors, metres, ``(..., J)``, after steps whose velocities sum to ``(...)``."""
        progress = self.progress_m[uav] + np.asarray(velocity) * self.scenario.step_s
        offset = self.trajectories[uav].at(progress)[..., None, :] - self.places
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))

    def packets(self, uav: int, velocity: IntArray, step: int) -> IntArray:
        """Packets that a step can move to the UAV, ``(..., J)``, after steps whose velocities sum to ``(...)``."""
        if self.links is None:
            return packets_per_step(self.distance(uav, velocity), self.scenario)
        table = self.links[uav]
        return np.asarray(table[step if len(table) > 1 else 0, np.asarray(velocity)])

    def chance(self, uav: int, velocity: IntArray, step: int) -> FloatArray:
        """The probability that each link holds, shaped as :meth:`packets`."""
        if self.chances is None:
            return np.ones((*np.shape(velocity), self.sensors))
        table = self.chances[uav]
        return np.asarray(table[step if len(table) > 1 else 0, np.asarray(velocity)])

    def links_until(self, step: int) -> list[IntArray] | None:
        """The links of the steps before this one."""
        return None if self.links is None else [table[:step] for table in self.links]

    def links_after(self, actions: IntArray) -> list[IntArray] | None:
        """The links after these actions ``(n, I, 2)``."""
        if self.links is None:
            return None
        flown = actions[:, :, 1].sum(axis=0).tolist()
        return [
            table[min(len(actions), len(table) - 1) :, summed:] for table, summed in zip(self.links, flown, strict=True)
        ]


class Found(NamedTuple):
    """A plan found by a search.

    Attributes:
        actions: shape ``(H, I, 2)``: sensor, velocity.
        expected_loss: packets, with the price of lateness.
    """

    actions: IntArray
    expected_loss: float


@dataclass(frozen=True, eq=False)
class Course:
    """The course of the sensors' queues when a fleet flies its actions.

    Attributes:
        queue: shape ``(H + 1, J)``, packets before each step and after the last.
        lost: shape ``(H, J)``, packets.
        link: shape ``(H, I)``, packets that the link could move if it holds; 0 for a failed transmission.
    """

    queue: IntArray
    lost: IntArray
    link: IntArray


def fly(problem: FleetProblem, actions: IntArray) -> Course:
    """Fly actions ``(H, I, 2)`` as the simulated world does: move, transfer, arrive, overflow.

    The transfers go in the order of the UAVs. A transfer fails if the link does not hold, if the sensor has served
    another UAV in this step, or if its battery cannot pay for one packet.
    """
    capacity = problem.scenario.queue_capacity
    queue, lost = [problem.queue], []
    battery = problem.battery.copy()
    link = np.zeros(actions.shape[:2], dtype=np.int64)
    for step, transfers in enumerate(_transfers(problem, actions)):
        left, served = queue[-1].copy(), set[int]()
        for uav, (sensor, budget, joules) in enumerate(transfers):
            affordable = int(battery[sensor] / joules + 1e-9)
            if budget is None or sensor in served or affordable < 1:
                continue
            served.add(sensor)
            link[step, uav] = budget
            moved = min(int(left[sensor]), budget, affordable)
            left[sensor] -= moved
            battery[sensor] = max(0.0, float(battery[sensor]) - moved * joules)
        filled = left + problem.arrivals[step]
        queue.append(np.minimum(filled, capacity))
        lost.append(filled - queue[-1])
    return Course(np.array(queue), np.array(lost), link)


def with_fixed(problem: FleetProblem, actions: IntArray | None) -> IntArray:
    """The actions, or full speed and sensor 0 for all UAVs, with the problem's fixed ones at the beginning.

    The nearest allowed velocity replaces a forbidden one.
    """
    if actions is None:
        start = np.zeros((problem.horizon, problem.uavs, 2), dtype=np.int64)
        start[:, :, 1] = problem.levels[-1]
    else:
        start = actions.copy()
        start[:, :, 1] = problem.levels[np.abs(start[:, :, 1, None] - problem.levels).argmin(axis=-1)]
    for uav, fixed in problem.fixed.items():
        start[: len(fixed), uav] = fixed
    return start


def _transfers(problem: FleetProblem, actions: IntArray) -> Iterator[list[tuple[int, int | None, float]]]:
    """By step and UAV: sensor, packets of the link (``None``: it does not hold), joules a packet."""
    world = problem.scenario
    flown, sensor = np.cumsum(actions[:, :, 1], axis=0), actions[:, :, 0]
    if problem.links is None:
        columns = []
        for uav in range(problem.uavs):
            distance = problem.distance(uav, flown[:, uav])
            columns.append(np.take_along_axis(distance, sensor[:, uav, None], axis=1)[:, 0])
        reach = np.stack(columns, axis=1)
        holds, budget = link_holds(reach, world), packets_per_step(reach, world)
        joules = world.transmit_power_w * (world.packet_bits / np.maximum(rate_bps(reach, world), 1e-12))
    else:
        budget = _chosen(problem.links, flown, sensor)
        holds = budget > 0
        joules = world.transmit_power_w * world.step_s / np.maximum(budget, 1)
    for step in range(len(actions)):
        rows = zip(*(a[step].tolist() for a in (sensor, holds, budget, joules)), strict=True)
        yield [(j, packets if held else None, joule) for j, held, packets, joule in rows]


def _chosen(tables: Sequence[NDArray[Any]], flown: IntArray, sensor: IntArray) -> NDArray[Any]:
    """The tables' entries for sums of velocities and sensors ``(H, I)``."""
    steps = np.arange(len(flown))
    whole = [table if len(table) > 1 else np.broadcast_to(table, (len(flown), *table.shape[1:])) for table in tables]
    return np.stack([table[steps, flown[:, uav], sensor[:, uav]] for uav, table in enumerate(whole)], axis=1)
