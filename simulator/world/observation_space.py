"""The observation space of a world's UAV."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from shared.world.channel import path_loss_db
from shared.world.scenario import Scenario
from shared.world.trajectory import Trajectory
from simulator.world.true_channel import LOSS_BOUNDS_DB, mean_only
from simulator.world.truth import LARGEST_ERROR


def observation_space(scenario: Scenario, path: Trajectory, recorded_gains: bool) -> spaces.Dict:
    """The space of :class:`simulator.world.PipelineWorld` for a UAV on that trajectory."""
    count = scenario.sensors
    modelled = mean_only(scenario) and not recorded_gains
    quietest, loudest = _gain_bounds(scenario) if modelled else (-LOSS_BOUNDS_DB[1], -LOSS_BOUNDS_DB[0])
    # The wind carries a UAV at most twice as far as still air would let it fly.
    stretch = 2.0 if scenario.wind_mps or scenario.gust_mps else 1.0
    farthest = path.length_m + stretch * scenario.steps * scenario.max_velocity * scenario.step_s
    # Rounding may put a circle's point slightly past its bounds.
    margin = 1e-6 + LARGEST_ERROR * scenario.position_noise_m
    lowest, highest = path.bounds

    def column(low: float, high: float) -> spaces.Box:
        return spaces.Box(low, high, (count,), np.float64)

    return spaces.Dict(
        {
            "step": spaces.Box(0, scenario.steps, (1,), np.int64),
            "position": spaces.Box(lowest - margin, highest + margin, dtype=np.float64),
            "progress": spaces.Box(0.0, farthest, (1,), np.float64),
            "sensor_position": spaces.Box(0.0, scenario.area_m, (count, 2), np.float64),
            "queue": column(0.0, float(scenario.queue_capacity)),
            "battery": column(0.0, scenario.battery_j),
            "channel_gain": column(quietest, loudest),
            "last_heard": spaces.Box(-1, scenario.steps, (count,), np.int64),
        }
    )


def _gain_bounds(scenario: Scenario) -> tuple[float, float]:
    """Bounds of the mean gain within the radio radius, dB, whichever of the two excess losses is larger.

    The margin of 1e-6 dB covers the rounding of the sum. 0 is always within the bounds, since it marks a sensor never
    heard.
    """
    excess = (scenario.los_excess_db, scenario.nlos_excess_db)
    free_space = scenario.model_copy(update={"los_excess_db": 0.0, "nlos_excess_db": 0.0})
    nearest, farthest = path_loss_db([0.0, scenario.radio_radius_m], free_space)
    return min(0.0, -farthest - max(excess) - 1e-6), max(0.0, -nearest - min(excess) + 1e-6)
