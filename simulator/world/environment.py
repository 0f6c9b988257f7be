"""The simulated world as a PettingZoo environment; the class docstring is its specification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypedDict

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv  # type: ignore[import-untyped]

from shared.channel import FloatArray, IntArray, Links, path_loss_db
from shared.scenario import SCENARIOS, Scenario
from shared.trajectory import Trajectory, trajectories
from simulator.world.actions import checked_actions
from simulator.world.beacons import Beacons
from simulator.world.fleet import Fleet
from simulator.world.sensors import Sensors, Streams
from simulator.world.true_channel import LOSS_BOUNDS_DB, TrueChannel

Cost = Literal["default", "paper"]


class Observation(TypedDict):
    """The observation of one UAV; shapes and units are in :class:`PipelineWorld`."""

    step: IntArray
    position: FloatArray
    progress: FloatArray
    sensor_position: FloatArray
    queue: FloatArray
    battery: FloatArray
    channel_gain: FloatArray
    last_heard: IntArray


class Info(TypedDict):
    """The outcome of one UAV's last action; see :class:`PipelineWorld`."""

    action_mask: NDArray[np.int8]
    failed: bool
    collected: int
    lost_packets: int
    cost: float


@dataclass(frozen=True, eq=False)
class StepTally:
    """One step of the whole fleet: the two losses of Eq. 5, the packets lost, and those collected.

    ``failures`` is the sum of f over UAVs, ``overflows`` the sum of g over sensors, ``collected`` has shape ``(J,)``.
    """

    step: int
    failures: int
    overflows: int
    lost_packets: int
    collected: IntArray

    @property
    def events(self) -> int:
        """Eq. 5's loss of the step: failed transmissions plus overflowing sensors."""
        return self.failures + self.overflows


class PipelineWorld(ParallelEnv[str, Observation, NDArray[np.int64]]):  # type: ignore[misc]
    """UAVs fly over a field of ground sensors and collect their packets before the queues overflow.

    J sensors, I UAVs, T steps and every other number named here are fields of the scenario.

    ## Agents
    ``uav_0`` .. ``uav_{I-1}``. All of them act at every step until the mission ends.

    ## Action space
    ``MultiDiscrete([J, max_velocity + 1])``: the sensor to collect from, and the velocity of this step in m/s.

    ## Observation space
    A ``Dict`` of arrays; J in a shape means one entry a sensor:

    | key | shape, type | meaning |
    |---|---|---|
    | ``step`` | ``(1,)`` int64 | steps flown so far, 0..T |
    | ``position`` | ``(2,)`` float64 | of this UAV, m; a trajectory may leave the area |
    | ``progress`` | ``(1,)`` float64 | of this UAV along its trajectory, m, its start included |
    | ``sensor_position`` | ``(J, 2)`` float64 | surveyed, m |
    | ``queue`` | ``(J,)`` float64 | packets waiting when last heard, 0..W |
    | ``battery`` | ``(J,)`` float64 | J left when last heard |
    | ``channel_gain`` | ``(J,)`` float64 | dB, minus the path loss to this UAV when last heard |
    | ``last_heard`` | ``(J,)`` int64 | the ``step`` of that beacon; -1 never heard, then the three above are 0 |

    The observation is partial. Before each observation every sensor sends a beacon, which costs no energy, so that even
    a sensor with a flat battery is heard. A UAV hears the sensors within ``radio_radius_m`` of its position,
    horizontally. The entries of the other sensors are those of the last beacon heard. A sensor is in range now exactly
    where ``last_heard == step``. UAVs do not share their observations.

    ## A step
    1. All UAVs fly ``velocity x step_s`` metres along their trajectories (circles counter-clockwise, or routes).
    2. From the new positions, ``uav_0`` first, each UAV collects from its sensor. The transmission fails (f = 1) if
       the sensor is out of the radio radius, if the path loss is at or past the threshold, if the sensor's radio is
       dead, if the sensor already served a UAV of a lower index in this step, or if the battery cannot pay for one
       packet. Otherwise
       ``min(queue, packets_per_step)`` packets move, fewer if the battery cannot pay for them. An empty queue is no
       failure. A failed transmission does not count as service.
    3. Packets arrive (Poisson, each sensor at its own rate).
    4. Packets in excess of W at a sensor are lost (g = 1 for that sensor), and its queue is W.

    ## Rewards
    ``reward = -cost``. With ``cost="default"``, ``c_i = f_i + lost_i / W``, where ``lost_i`` are the packets lost in
    this step at the sensors with a usable link to UAV i at its new position. With ``cost="paper"``, Eq. 5: the sum of
    all f and all g of this step, the same for every UAV.

    ## Infos
    ``action_mask``: flat int8, J entries for the sensors (1 for those heard at least once; all 1 if none was)
    followed by ``max_velocity + 1`` ones. ``failed``: f. ``collected``: packets. ``lost_packets``: ``lost_i``.
    ``cost``: as above. After ``reset`` the last four are ``False``, 0, 0 and 0.0.

    ## Start
    Positions, arrival rates, initial queues, start angles, all T x J arrivals and the true channel are drawn at
    ``reset`` from separate children of ``SeedSequence(seed)``: the same seed gives the same world to the bit, whatever
    the actions. ``reset`` without a seed draws the next world of the last seed given, or of a fresh one.

    ## Episode end
    Every agent is truncated at step T; nothing terminates.

    ## For reports
    ``scenario``; ``sensors`` (true queues and batteries); ``fleet`` (the UAVs' positions); ``tally``, one
    :class:`StepTally` a step flown.

    Raises:
        ValueError: ``step`` before ``reset`` or after the end, without an action of a live agent, or with an action out
            of bounds (the world does not change then); ``render`` without ``render_mode="rgb_array"``; an unknown cost.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "pipeline_v0", "render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(
        self,
        scenario: Scenario = SCENARIOS["paper"],
        *,
        arrivals: IntArray | None = None,
        cost: Cost = "default",
        render_mode: str | None = None,
    ) -> None:
        if cost not in ("default", "paper"):
            raise ValueError(f"unknown cost {cost!r}: choose one of default, paper")
        self.scenario = scenario
        self.arrivals = arrivals
        self.cost = cost
        self.render_mode = render_mode
        self.possible_agents = [f"uav_{i}" for i in range(scenario.uavs)]
        self.agents: list[str] = []
        self.tally: list[StepTally] = []
        self.sensors: Sensors
        self.fleet: Fleet
        self.channel: TrueChannel
        levels = [scenario.sensors, scenario.max_velocity + 1]
        self._action_spaces = {agent: spaces.MultiDiscrete(levels) for agent in self.possible_agents}
        self._observation_spaces = {
            agent: _observation_space(scenario, path)
            for agent, path in zip(self.possible_agents, trajectories(scenario), strict=True)
        }
        self.state_space = spaces.Box(-np.inf, np.inf, (1 + 2 * scenario.uavs + 4 * scenario.sensors,), np.float32)
        self._entropy: Any = None
        self._missions = 0

    def observation_space(self, agent: str) -> spaces.Dict:
        """The agent's observation space; the trajectories, hence the bounds of ``position``, differ between agents."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.MultiDiscrete:
        """The agent's action space."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Draw a world, and return the first observations and infos; ``options`` is unused."""
        if seed is not None or self._entropy is None:
            self._entropy = np.random.SeedSequence(seed).entropy
            self._missions = 0
        key = (self._missions,) if self._missions else ()
        self._missions += 1
        streams = Streams.of(np.random.SeedSequence(self._entropy, spawn_key=key))
        self.sensors = Sensors(self.scenario, streams, self.arrivals)
        self.fleet = Fleet.draw(self.scenario, streams.angles)
        self.channel = TrueChannel.draw(self.scenario, streams)
        self.tally = []
        self.agents = self.possible_agents[:]
        self._beacons = Beacons(self.scenario.uavs, self.scenario.sensors)
        position = self.fleet.positions
        observations = self._observe(position, self._links(position))
        zeros = np.zeros(self.scenario.uavs, dtype=np.int64)
        return observations, self._infos(zeros, zeros, zeros, zeros.astype(np.float64))

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        """Fly one step; see the class docstring."""
        if not self.agents:
            raise ValueError("step after the mission's end: reset first" if self.tally else "step before reset")
        chosen = checked_actions(actions, self.agents, self.scenario)
        step = len(self.tally)
        position = self.fleet.advance(chosen[:, 1] * self.scenario.step_s)
        links = self._links(position)
        usable = links.hold & self.channel.working(step + 1)
        failed, moved = self._collect(chosen[:, 0], links, usable)
        lost = self.sensors.arrive(step)
        collected = np.bincount(chosen[:, 0], weights=moved, minlength=self.scenario.sensors).astype(np.int64)
        tally = StepTally(step, int(failed.sum()), int(np.count_nonzero(lost)), int(lost.sum()), collected)
        self.tally.append(tally)

        blamed = usable @ lost
        cost = failed + blamed / self.scenario.queue_capacity
        if self.cost == "paper":
            cost = np.full(self.scenario.uavs, float(tally.events))
        over = len(self.tally) == self.scenario.steps
        observations = self._observe(position, links)
        infos = self._infos(failed, moved, blamed, cost)
        rewards = {agent: -infos[agent]["cost"] for agent in self.agents}
        terminations = dict.fromkeys(self.agents, False)
        truncations = dict.fromkeys(self.agents, over)
        if over:
            self.agents = []
        return observations, rewards, terminations, truncations, infos

    def state(self) -> NDArray[np.float32]:
        """The true state for centralised critics, flat float32 of length ``1 + 2 I + 4 J``.

        In this order: step / T; UAV positions / area side (x, y of ``uav_0``, ...); sensor positions / area
        side (x, y of sensor 0, ...); queues / W; batteries / initial battery.

        Raises:
            ValueError: before the first ``reset``.
        """
        if not hasattr(self, "sensors"):
            raise ValueError("state before reset")
        side, sensors = self.scenario.area_m, self.sensors
        parts = (
            [len(self.tally) / self.scenario.steps],
            self.fleet.positions.ravel() / side,
            sensors.positions.ravel() / side,
            sensors.queue / self.scenario.queue_capacity,
            sensors.battery / self.scenario.battery_j,
        )
        return np.concatenate(parts).astype(np.float32)

    def render(self) -> NDArray[np.uint8]:
        """The map as an RGB image, shape ``(600, 600, 3)``: trajectories, UAVs, and sensors filled by their queues."""
        if self.render_mode != "rgb_array":
            raise ValueError(f"render_mode is {self.render_mode!r}: only 'rgb_array' can be rendered")
        if not hasattr(self, "sensors"):
            raise ValueError("render before reset")
        from simulator.world.rendering import render_map

        return render_map(self)

    def _links(self, position: FloatArray) -> Links:
        """The links of every UAV to every sensor, ``(I, J)``."""
        offset = position[:, None, :] - self.sensors.positions
        return self.channel.links(np.hypot(offset[..., 0], offset[..., 1]), self.channel.excess_db(position))

    def _collect(self, chosen: IntArray, links: Links, usable: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
        """Serve the UAVs in order; returns f and the packets moved, each ``(I,)``."""
        pairs = (np.arange(self.scenario.uavs), chosen)
        reach, able = links[pairs], usable[pairs].tolist()
        budget, rate = reach.packets.tolist(), reach.rate_bps.tolist()
        failed, moved = np.ones((2, self.scenario.uavs), dtype=np.int64)
        served: set[int] = set()
        for uav, sensor in enumerate(chosen.tolist()):
            packets = None
            if able[uav] and sensor not in served:
                packets = self.sensors.transmit(sensor, budget[uav], rate[uav])
            if packets is not None:
                served.add(sensor)
                failed[uav] = 0
            moved[uav] = packets or 0
        return failed, moved

    def _observe(self, position: FloatArray, links: Links) -> dict[str, Observation]:
        """Record the beacons in range, and return a copy of every live UAV's observation."""
        step = len(self.tally)
        self._beacons.hear(step, self.sensors, links, self.scenario.radio_radius_m)
        return {
            agent: Observation(
                step=np.array([step]),
                position=position[uav].copy(),
                progress=self.fleet.progress_m[uav : uav + 1].copy(),
                sensor_position=self.sensors.positions.copy(),
                queue=self._beacons.queue[uav].copy(),
                battery=self._beacons.battery[uav].copy(),
                channel_gain=self._beacons.gain_db[uav].copy(),
                last_heard=self._beacons.step[uav].copy(),
            )
            for uav, agent in enumerate(self.agents)
        }

    def _infos(self, failed: IntArray, moved: IntArray, blamed: IntArray, cost: FloatArray) -> dict[str, Info]:
        selectable = self._beacons.step >= 0
        selectable |= ~selectable.any(axis=1, keepdims=True)
        mask = np.ones((self.scenario.uavs, self.scenario.sensors + self.scenario.max_velocity + 1), dtype=np.int8)
        mask[:, : self.scenario.sensors] = selectable
        rows = zip(self.agents, mask, failed.tolist(), moved.tolist(), blamed.tolist(), cost.tolist(), strict=True)
        return {
            agent: Info(action_mask=m.copy(), failed=bool(f), collected=c, lost_packets=lost, cost=paid)
            for agent, m, f, c, lost, paid in rows
        }


def _observation_space(scenario: Scenario, path: Trajectory) -> spaces.Dict:
    count = scenario.sensors
    quietest, loudest = _gain_bounds(scenario)
    farthest = path.length_m + scenario.steps * scenario.max_velocity * scenario.step_s
    lowest, highest = path.bounds

    def column(low: float, high: float) -> spaces.Box:
        return spaces.Box(low, high, (count,), np.float64)

    return spaces.Dict(
        {
            "step": spaces.Box(0, scenario.steps, (1,), np.int64),
            # Rounding may put a circle's point slightly past its bounds.
            "position": spaces.Box(lowest - 1e-6, highest + 1e-6, dtype=np.float64),
            "progress": spaces.Box(0.0, farthest, (1,), np.float64),
            "sensor_position": spaces.Box(0.0, scenario.area_m, (count, 2), np.float64),
            "queue": column(0.0, float(scenario.queue_capacity)),
            "battery": column(0.0, scenario.battery_j),
            "channel_gain": column(quietest, loudest),
            "last_heard": spaces.Box(-1, scenario.steps, (count,), np.int64),
        }
    )


def _gain_bounds(scenario: Scenario) -> tuple[float, float]:
    """Bounds of the gain within the radio radius, dB, whichever of the two excess losses is larger.

    The margin of 1e-6 dB covers the rounding of the sum. 0 is always within the bounds, since it marks a sensor never
    heard.
    """
    if scenario.shadowing_db or scenario.route_shadowing_db:
        return -LOSS_BOUNDS_DB[1], -LOSS_BOUNDS_DB[0]
    excess = (scenario.los_excess_db, scenario.nlos_excess_db)
    free_space = scenario.model_copy(update={"los_excess_db": 0.0, "nlos_excess_db": 0.0})
    nearest, farthest = path_loss_db([0.0, scenario.radio_radius_m], free_space)
    return min(0.0, -farthest - max(excess) - 1e-6), max(0.0, -nearest - min(excess) + 1e-6)
