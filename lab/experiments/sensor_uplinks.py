"""The effect of sensors that report to the edge themselves, such as by LoRaWAN, besides their beacons to UAVs."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import CHANCE, Scheme, edge_planner, guided
from lab.experiments.uplinks_of_sensors import UplinkPlan

# Every 30 s, which EU868's duty cycle of 1% allows a device at spreading factor 9 or less.
_HALF = UplinkPlan(share=0.5, every=3)
_ALL = UplinkPlan(share=1.0, every=1)


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        guided(),
        guided("guided_half", "guided, half of the sensors report", sensor_uplinks=_HALF),
        guided("guided_chance", "guided, LLM draws", backing=CHANCE),
        guided(
            "guided_chance_half",
            "guided, LLM draws, half of the sensors report",
            backing=CHANCE,
            sensor_uplinks=_HALF,
        ),
        edge_planner(),
        edge_planner("edge_planner_half", "edge's planner, half of the sensors report", sensor_uplinks=_HALF),
        edge_planner("edge_planner_all", "edge's planner, all sensors report every step", sensor_uplinks=_ALL),
    ]


EXPERIMENT = Experiment(
    name="sensor-uplinks",
    title="Sensors that report to the edge themselves",
    summary="half of the sensors report every third step over a network on the ground, all in every step, or none",
    schemes=_schemes,
    measures=(*LOSSES, "failures"),
    figures=(FigureSpec("sensor_uplinks", "bars", ("lost_packets",), "Lost packets of a mission."),),
    pairs=(
        ("guided_half", "guided"),
        ("guided_chance_half", "guided_chance"),
        ("edge_planner_half", "edge_planner"),
        ("edge_planner_all", "edge_planner"),
    ),
    paired_measures=("lost_packets",),
    notes=(
        "The sensors that report are drawn by the world's seed. A reading of a step's start reaches the edge after the "
        "fleet's decisions of that step, so decisions know it from the next step on. None is lost.",
    ),
)
