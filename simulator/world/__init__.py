"""The simulated world, as a PettingZoo environment."""

from simulator.world.environment import Cost, Info, Observation, PipelineWorld, StepTally

__all__ = ["Cost", "Info", "Observation", "PipelineWorld", "StepTally"]
