"""The simulated world, in the terms of a PettingZoo environment; the class docstring is its specification."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared.world.channel import IntArray
from shared.world.scenario import SCENARIOS, Scenario
from simulator.world.batch import BatchStep, Draw, Fleet, VectorWorld, stacked
from simulator.world.gain_trace import GainTrace
from simulator.world.observation import Info, Observation, StepTally
from simulator.world.sensors import Sensors
from simulator.world.truth import Truth


class PipelineWorld:
    """UAVs fly over a field of ground sensors and collect their packets before the queues overflow.

    J sensors, I UAVs, T steps and every other number named here are fields of the scenario.

    ## Agents
    ``uav_0`` .. ``uav_{I-1}``. All of them act at every step until the mission ends; some may leave before.

    ## Action space
    ``MultiDiscrete([J, max_velocity + 1])``: the sensor to collect from, and the velocity of this step in m/s.

    ## Observation space
    A ``Dict`` of arrays; J in a shape means one entry a sensor:

    | key | shape, type | meaning |
    |---|---|---|
    | ``step`` | ``(1,)`` int64 | steps flown so far, 0..T |
    | ``position`` | ``(2,)`` float64 | of this UAV as reported, m; a trajectory may leave the area |
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
    1. All UAVs fly ``velocity x step_s`` metres along their trajectories (circles counter-clockwise, or routes), or
       what the wind makes of it.
    2. From the new positions, ``uav_0`` first, each UAV collects from its sensor. The transmission fails (f = 1) if
       the sensor is out of the radio radius, if the path loss is at or past the threshold, if the sensor's radio is
       dead, if the sensor already served a UAV of a lower index in this step, or if the battery cannot pay for one
       packet. Otherwise
       ``min(queue, packets_per_step)`` packets move, fewer if the battery cannot pay for them. An empty queue is no
       failure. A failed transmission does not count as service.
    3. Packets arrive (Poisson, each sensor at its own rate, which bursts may change).
    4. Packets in excess of W at a sensor are lost (g = 1 for that sensor), and its queue is W.

    ## What the model leaves out
    The fields of :class:`shared.world.scenario.Unmodelled`, all off by default, make a world differ from what an edge
    plans with; docs/reference/worlds.md says how. The path loss is ``mean + own_j + way_j(x, y) + fade_ijt +
    trace_ij``, within 0..400 dB (:class:`~simulator.world.truth.TrueChannel`). A transfer and the beacon after
    it meet the same loss, and ``channel_gain`` is minus all of it. ``progress`` is true. The losses of a dead radio are
    nobody's ``lost_i``. A UAV that left neither flies, hears nor collects.

    ## Rewards
    ``reward = -c_i``, ``c_i = f_i + lost_i / W``, where ``lost_i`` are the packets lost in this step at the sensors
    with a usable link to UAV i at its new position. ``tally`` has the paper's P_l of every step.

    ## Infos
    ``failed``: f. ``collected``: packets. ``lost_packets``: ``lost_i``. ``cost``: c_i. After ``reset`` they are
    ``False``, 0, 0 and 0.0.

    ## Start
    Positions, arrival rates, initial queues, start angles, all T x J arrivals and what the model leaves out are drawn
    at ``reset`` from separate children of ``SeedSequence(seed)``: the same seed gives the same world to the bit,
    whatever the actions. ``reset`` without a seed draws the next world of the last seed given, or of a fresh one.

    ## Episode end
    Every remaining agent is truncated at step T. Only a UAV that leaves before is terminated, with the observation
    after its last step.

    ## For reports
    ``scenario``; ``sensors`` (true queues and batteries); ``fleet`` (the UAVs' positions); ``truth`` (what the
    model leaves out); ``tally``, one :class:`StepTally` a step flown. The world is a
    :class:`~simulator.world.batch.VectorWorld` of one world, and its transfers, arrivals and overflows are those of
    :mod:`shared.world.step_rule`.

    Args:
        arrivals: a trace, shape ``(at least T, J)``, instead of drawn arrivals.
        gains: recorded excess losses, beside the drawn ones.

    Raises:
        ValueError: ``step`` before ``reset`` or after the end, without an action of a live agent, or with an action out
            of bounds (the world does not change then).
    """

    def __init__(
        self,
        scenario: Scenario = SCENARIOS["paper"],
        *,
        arrivals: IntArray | None = None,
        gains: GainTrace | None = None,
    ) -> None:
        self.scenario = scenario
        self.arrivals = arrivals
        self.gains = gains
        self.possible_agents = [f"uav_{i}" for i in range(scenario.uavs)]
        self._index = {agent: uav for uav, agent in enumerate(self.possible_agents)}
        self.agents: list[str] = []
        self.tally: list[StepTally] = []
        self.sensors: Sensors
        self.truth: Truth
        self._worlds = VectorWorld(scenario)
        self._entropy: Any = None
        self._missions = 0

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Draw a world, and return the first observations and infos; ``options`` is unused."""
        if seed is not None or self._entropy is None:
            self._entropy = np.random.SeedSequence(seed).entropy
            self._missions = 0
        key = (self._missions,) if self._missions else ()
        self._missions += 1
        draw = Draw.one(self.scenario, np.random.SeedSequence(self._entropy, spawn_key=key), self.arrivals, self.gains)
        observed = self._worlds.start(stacked([draw]))
        self.sensors, self.truth = self._worlds.sensors.of(0), draw.truth
        self.tally = []
        self.agents = self.possible_agents[:]
        return self._own(observed), self._infos(None)

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        """Fly one step; see the class docstring."""
        if not self.agents:
            raise ValueError("step after the mission's end: reset first" if self.tally else "step before reset")
        chosen = checked_actions(actions, self.live, self.scenario)
        observed, outcome = self._worlds.fly(chosen[None, :, 0], chosen[None, :, 1])
        self.tally.append(outcome.tally(0, len(self.tally)))
        observations, infos = self._own(observed), self._infos(outcome)
        rewards = {agent: -infos[agent]["cost"] for agent in self.agents}
        flown = len(self.tally)
        over, present = flown == self.scenario.steps, self.truth.faults.present(flown).tolist()
        terminations = {agent: not over and not present[uav] for agent, uav in self.live.items()}
        truncations = dict.fromkeys(self.agents, over)
        self.agents = [agent for agent, left in terminations.items() if not (over or left)]
        return observations, rewards, terminations, truncations, infos

    @property
    def fleet(self) -> Fleet:
        """The fleet now."""
        fleet = self._worlds.fleet
        return Fleet(fleet.trajectories, fleet.start_m[0], fleet.progress_m[0])

    @property
    def live(self) -> dict[str, int]:
        """The index of each live agent's UAV, in their order."""
        return {agent: self._index[agent] for agent in self.agents}

    def _own(self, observed: Observation) -> dict[str, Observation]:
        """A copy of every live UAV's observation."""
        columns: Any = {key: values[0] for key, values in cast(dict[str, NDArray[Any]], observed).items()}
        return {
            agent: cast(Observation, {key: values[uav].copy() for key, values in columns.items()})
            for agent, uav in self.live.items()
        }

    def _infos(self, outcome: BatchStep | None) -> dict[str, Info]:
        """The info of every live agent; without an outcome that of a reset."""
        nothing = np.zeros((4, 1, self.scenario.uavs))
        columns = nothing if outcome is None else (outcome.failed, outcome.moved, outcome.blamed, outcome.cost)
        failed, moved, blamed, cost = (column[0].tolist() for column in columns)
        return {
            agent: Info(
                failed=bool(failed[uav]), collected=int(moved[uav]), lost_packets=int(blamed[uav]), cost=cost[uav]
            )
            for agent, uav in self.live.items()
        }


def checked_actions(actions: Mapping[str, ArrayLike], agents: Mapping[str, int], scenario: Scenario) -> IntArray:
    """The actions of all agents as ``(I, 2)`` integers: sensor, velocity; zeros for UAVs that have departed.

    ``agents`` has the UAV of each live agent.

    Raises:
        ValueError: an agent is unknown or has no action, or an action is not two integers within their bounds.
    """
    for agent in actions:
        if agent not in agents:
            raise ValueError(f"{agent}: no such agent")
    limits = (("sensor", scenario.sensors - 1), ("velocity", scenario.max_velocity))
    chosen = np.zeros((scenario.uavs, 2), dtype=np.int64)
    for agent, uav in agents.items():
        if agent not in actions:
            raise ValueError(f"{agent}: no action")
        action = np.asarray(actions[agent])
        if action.shape != (2,) or action.dtype.kind not in "iu":
            raise ValueError(f"{agent}: action {actions[agent]!r} is not two integers (sensor, velocity)")
        for value, (name, last) in zip(action.tolist(), limits, strict=True):
            if not 0 <= value <= last:
                raise ValueError(f"{agent}: {name} {value} is not in 0..{last}")
        chosen[uav] = action
    return chosen
