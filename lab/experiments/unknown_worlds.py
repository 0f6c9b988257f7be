"""Every scheme in worlds that differ from the edge's model, and in two that do not."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import (
    BOUND,
    CHANCE,
    FORMULA_PLANNER,
    INFORMED,
    PLANNER,
    Scheme,
    at_full_speed,
    available_locals,
    edge_planner,
    guided,
    value,
)

_HEURISTICS = ("longest_queue", "queue_and_channel", "max_gain", "nearest")


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        guided("guided_chance", "guided, LLM draws", backing=CHANCE),
        edge_planner(),
        value(),
        *available_locals(PLANNER, FORMULA_PLANNER),
        INFORMED,
        *available_locals("madqn", "mappo", "eof", "wqcs", *_HEURISTICS),
        *map(at_full_speed, _HEURISTICS),
        BOUND,
    ]


EXPERIMENT = Experiment(
    name="unknown-worlds",
    title="Worlds that are not the edge's own model",
    summary="every scheme on shadowed, fading, bursty, windy, faulty and field, beside paper and stress",
    schemes=_schemes,
    measures=(*LOSSES, "failures"),
    figures=(FigureSpec("unknown_worlds", "bars", ("lost_packets",), "Lost packets of a mission by scenario."),),
    references=(INFORMED.name,),
    pairs=(("edge_planner", FORMULA_PLANNER), (PLANNER, FORMULA_PLANNER), ("value_reach", "eof")),
    paired_measures=("lost_packets",),
    worlds=("paper", "stress", "shadowed", "fading", "bursty", "windy", "faulty", "field"),
    heuristics=tuple(name + speed for name in _HEURISTICS for speed in ("", "_fast")) + ("eof", "wqcs"),
    notes=(
        "The planner without learning reckons with the scenario's mean path loss, mean arrival rate and still air to "
        "the mission's end. The one that is told the true links knows shadowing, every fade to come, dead radios, the "
        "links' share and the mean wind, but no arrival and no gust. It is a reference, for no UAV could fly it.",
        "`LLM draws` answers a uniform draw of the letters offered: mode guided without help from its LLM.",
        "MADQN, MAPPO and the modules' start fly every world with the weights that ship.",
    ),
)
