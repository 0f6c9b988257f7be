"""The problem of planning for a fleet, and the course of the sensors' queues under a plan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.planning.queue_chains import QueueChains
from shared.world.channel import FloatArray, IntArray, Links, packets_per_step
from shared.world.scenario import Scenario
from shared.world.step_rule import arrive, joules_a_packet, transfer
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
        tops: shape ``(I,)``, the highest velocity that each UAV reaches; ``None``: all that are allowed. Of a UAV that
            reaches none of these, a plan flies the lowest.
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
        ValueError: a field has a wrong shape or value; the message names the field.
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
    tops: IntArray | None = None
    weights: FloatArray | None = None
    late: FloatArray | None = None
    links: Sequence[IntArray] | None = None
    chances: Sequence[FloatArray] | None = None
    chains: QueueChains | None = None
    stages: Sequence[IntArray] | None = None

    def __post_init__(self) -> None:
        steps, count, levels = len(self.arrivals), len(self.places), self.scenario.max_velocity + 1
        if self.arrivals.ndim != 2 or not steps:
            raise ValueError(f"arrivals has shape {self.arrivals.shape}, must be (H, {count}) with H at least 1")
        shapes: dict[str, tuple[int, ...]] = {
            "progress_m": (self.uavs,),
            "places": (count, 2),
            "queue": (count,),
            "battery": (count,),
            "arrivals": (steps, count),
            "usable": (steps, count),
            "allowed": (levels,),
            "tops": (self.uavs,),
            "weights": (count,),
            "late": (steps + 1, steps + 1, count),
        }
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is not None and value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, must be {shape}")
        self._check_tables(steps * (levels - 1) + 1, count)
        self._check_values()
        if self.allowed is not None and not self.allowed.any():
            raise ValueError("allowed has no velocity")
        # The compiled search reads the stages as indices, without a check.
        most = 0 if self.chains is None else len(self.chains.after)
        if any(table.min() < 0 or table.max() >= most for table in self.stages or ()):
            raise ValueError(f"stages must be those of chains, 0..{most - 1}")

    def _check_tables(self, sums: int, count: int) -> None:
        steps = (1, self.horizon)
        for name, dimensions in (("links", 3), ("chances", 3), ("stages", 2)):
            tables = getattr(self, name) or ()
            if len(tables) not in (0, self.uavs):
                raise ValueError(f"{name} has tables of {len(tables)} UAVs, there are {self.uavs}")
            for uav, table in enumerate(tables):
                right = table.ndim == dimensions and (dimensions == 2 or len(table) in steps)
                if not right or table.shape[-2] < sums or table.shape[-1] != count:
                    raise ValueError(f"{name}[{uav}] has shape {table.shape}, must end with ({sums}, {count})")
        if self.chances is not None and [c.shape for c in self.chances] != [t.shape for t in self.links or ()]:
            raise ValueError("chances must have the shapes of links")
        for uav, actions in self.fixed.items():
            if not 0 <= uav < self.uavs or actions.ndim != 2 or actions.shape[1] != 2 or len(actions) > self.horizon:
                raise ValueError(f"fixed[{uav}] has shape {actions.shape}, must be (n, 2) of a UAV")

    def _check_values(self) -> None:
        for name, arrays in (("queue", [self.queue]), ("arrivals", [self.arrivals]), ("links", self.links or ())):
            if any(array.dtype.kind not in "iu" or array.min(initial=0) < 0 for array in arrays):
                raise ValueError(f"{name} must be whole packets, at least 0")
        if self.queue.max(initial=0) > self.scenario.queue_capacity:
            raise ValueError(f"queue has {self.queue.max()} packets, the capacity is {self.scenario.queue_capacity}")
        if not all(((chance >= 0) & (chance <= 1)).all() for chance in self.chances or ()):
            raise ValueError("chances must be probabilities, 0..1")

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

    @property
    def reached(self) -> IntArray:
        """The number of these velocities that each UAV reaches, at least 1, ``(I,)``."""
        levels = self.levels
        if self.tops is None:
            return np.full(self.uavs, len(levels))
        return np.maximum(levels.searchsorted(self.tops, side="right"), 1)

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
    """Fly actions ``(H, I, 2)`` by the rule of :mod:`shared.world.step_rule`."""
    queue, lost, battery = [problem.queue], [], problem.battery.copy()
    sensor, (holds, budget, joules) = actions[:, :, 0], _transfers(problem, actions)
    link = np.zeros(sensor.shape, dtype=np.int64)
    for step, arrivals in enumerate(problem.arrivals):
        left = queue[-1].copy()
        served, _ = transfer(left, battery, sensor[step], holds[step], budget[step], joules[step])
        link[step] = budget[step] * served
        filled, over = arrive(left, arrivals, problem.scenario.queue_capacity)
        queue.append(filled)
        lost.append(over)
    return Course(np.array(queue), np.array(lost), link)


def with_fixed(problem: FleetProblem, actions: IntArray) -> IntArray:
    """The actions with the fixed ones at the beginning; the nearest allowed velocity replaces a forbidden one."""
    start = actions.copy()
    start[:, :, 1] = problem.levels[np.abs(start[:, :, 1, None] - problem.levels).argmin(axis=-1)]
    start[:, :, 1] = np.minimum(start[:, :, 1], problem.levels[problem.reached - 1])
    for uav, fixed in problem.fixed.items():
        start[: len(fixed), uav] = fixed
    return start


def _transfers(problem: FleetProblem, actions: IntArray) -> tuple[NDArray[np.bool_], IntArray, FloatArray]:
    """Whether each transfer's link holds, its packets, and joules a packet, ``(H, I)`` each."""
    world = problem.scenario
    flown, sensor = np.cumsum(actions[:, :, 1], axis=0), actions[:, :, 0]
    if problem.links is not None:
        budget = _chosen(problem.links, flown, sensor)
        return budget > 0, budget, world.transmit_power_w * world.step_s / np.maximum(budget, 1)
    columns = [
        np.take_along_axis(problem.distance(uav, flown[:, uav]), sensor[:, uav, None], axis=1)[:, 0]
        for uav in range(problem.uavs)
    ]
    links = Links.at(np.stack(columns, axis=1), world)
    return links.hold, links.packets, joules_a_packet(links.rate_bps, world)


def _chosen(tables: Sequence[NDArray[Any]], flown: IntArray, sensor: IntArray) -> NDArray[Any]:
    """The tables' entries for sums of velocities and sensors ``(H, I)``."""
    steps = np.arange(len(flown))
    whole = [table if len(table) > 1 else np.broadcast_to(table, (len(flown), *table.shape[1:])) for table in tables]
    return np.stack([table[steps, flown[:, uav], sensor[:, uav]] for uav, table in enumerate(whole)], axis=1)
