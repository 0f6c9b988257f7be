"""The differences of one world, or a batch of worlds, from an edge's planning model."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shared.world.channel import FloatArray
from shared.world.scenario import Scenario
from simulator.world.faults import Faults
from simulator.world.gain_trace import GainTrace
from simulator.world.sensors import Streams
from simulator.world.step_noise import StepNoise
from simulator.world.true_channel import TrueChannel, mean_only
from simulator.world.wind import Wind

# The largest error of a reported position on each axis, in standard deviations.
LARGEST_ERROR = 5.0


@dataclass(frozen=True, eq=False)
class Truth:
    """Channel, wind, faults and position errors of one world, or of B worlds of one scenario."""

    channel: TrueChannel
    wind: Wind
    faults: Faults
    position_noise: StepNoise

    @classmethod
    def draw(cls, scenario: Scenario, streams: Streams, gains: GainTrace | None = None) -> Self:
        """One world's; ``gains`` adds measured excess losses."""
        faults = Faults.draw(scenario, streams.faults)
        channel = TrueChannel.draw(scenario, streams, faults, gains)
        return cls(channel, Wind.draw(scenario, streams.gusts), faults, StepNoise.draw(streams.position_noise))

    @property
    def differs(self) -> bool:
        """Whether links, wind or the fleet differ from what an edge plans with."""
        channel = self.channel
        modelled = mean_only(channel.scenario, channel.trace) and not channel.changes
        return not modelled or self.wind.blows or channel.scenario.departures > 0

    def reported(self, position: FloatArray, instant: int) -> FloatArray:
        """The positions that UAVs at ``(..., I, 2)`` report at an instant, metres."""
        deviation = self.channel.scenario.position_noise_m
        if not deviation:
            return position
        errors = self.position_noise.normal(instant, position.shape[-2:])
        return position + deviation * np.clip(errors, -LARGEST_ERROR, LARGEST_ERROR)
