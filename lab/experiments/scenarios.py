"""The main schemes beyond the paper's world: a pipeline, a weak link, a dense field, a lossy uplink, a user's world."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import (
    CHANCE,
    PLANNER,
    Scheme,
    at_full_speed,
    available_locals,
    edge_planner,
    edge_policy,
    guided,
    llm,
    value,
    value_as_written,
)

_HEURISTICS = ("eof", "wqcs", "longest_queue", "queue_and_channel", "max_gain", "nearest", "random")


def _schemes(setup: Setup) -> list[Scheme]:
    draws = guided("guided_chance", "guided, LLM draws", backing=CHANCE)
    ours = [llm(), guided(), draws, value_as_written(), value(), edge_policy(), edge_planner()]
    return [*ours, *available_locals("madqn", "mappo", PLANNER, *_HEURISTICS), at_full_speed("longest_queue")]


EXPERIMENT = Experiment(
    name="scenarios",
    title="Beyond the paper's world",
    summary="the main schemes on paper, pipeline, stress, dense, lossy_uplink, and on --world's",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "jain", "llm_decided_pct"),
    figures=(
        FigureSpec("scenarios_packets", "bars", ("lost_packets",), "Lost packets of a mission by scenario."),
        FigureSpec("scenarios_events", "bars", ("events",), "Loss events of a mission by scenario."),
    ),
    references=("eof", "wqcs"),
    worlds=("paper", "pipeline", "stress", "dense", "lossy_uplink"),
    notes=(
        "`LLM draws` answers a uniform draw of the letters offered: what mode guided brings whatever the LLM.",
        "MADQN and MAPPO were trained on the scenario `paper` alone; elsewhere they are out of it. "
        "A network made for other numbers of sensors and UAVs cannot fly there and is left out.",
        "In lossy_uplink a request that was lost three times is decided on board by the longest queue, and counts as "
        "the scheme's.",
    ),
)
