"""The worth of sensors that report to the edge themselves, such as by LoRaWAN, beside the UAVs that hear them."""

from __future__ import annotations

from simulator.experiments.measures import LOSSES
from simulator.experiments.plan import Experiment, FigureSpec, Setup
from simulator.experiments.schemes import CHANCE, Scheme, edge_planner, guided
from simulator.flying.sensor_uplinks import UplinkPlan

# Half of the sensors, each every 30 s: a class A device at spreading factor 7 may send more often at 1% duty cycle.
_HALF = UplinkPlan(share=0.5, every=3)


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        guided(),
        guided("guided_uplinks", "guided, half of the sensors report", sensor_uplinks=_HALF),
        guided("guided_chance", "guided, LLM draws", backing=CHANCE),
        guided(
            "guided_chance_uplinks",
            "guided, LLM draws, half of the sensors report",
            backing=CHANCE,
            sensor_uplinks=_HALF,
        ),
        edge_planner(),
        edge_planner("edge_planner_uplinks", "edge's planner, half of the sensors report", sensor_uplinks=_HALF),
    ]


EXPERIMENT = Experiment(
    name="sensor-uplinks",
    title="Sensors that report to the edge themselves",
    summary="half of the sensors report every third step over a network on the ground, and none does",
    schemes=_schemes,
    measures=(*LOSSES, "failures"),
    figures=(FigureSpec("sensor_uplinks", "bars", ("lost_packets",), "Lost packets of a mission."),),
    pairs=(
        ("guided_uplinks", "guided"),
        ("guided_chance_uplinks", "guided_chance"),
        ("edge_planner_uplinks", "edge_planner"),
    ),
    paired_measures=("lost_packets",),
    notes=(
        "The sensors that report are drawn by the world's seed. A reading of a step's start reaches the edge after the "
        "fleet's decisions of that step, so every decision knows it a step late. None is lost.",
    ),
)
