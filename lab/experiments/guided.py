"""Mode guided with different LLMs, with and without the planner among its advisers."""

from __future__ import annotations

from lab.experiments.measures import LOSS_CURVES, LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import (
    BOUND,
    CHANCE,
    WORST,
    Scheme,
    at_full_speed,
    available_locals,
    edge_planner,
    edge_policy,
    guided,
    value,
)

_POLICIES = ("madqn", "mappo", "eof", "wqcs", "longest_queue", "queue_and_channel", "max_gain")


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        guided(),
        guided("guided_chance", "guided, LLM draws", backing=CHANCE),
        guided("guided_worst", "guided, LLM names the worst", backing=WORST),
        guided("guided_alone", "guided, no planner", planner="off"),
        guided("guided_alone_chance", "guided, no planner, LLM draws", planner="off", backing=CHANCE),
        guided("guided_alone_worst", "guided, no planner, LLM names the worst", planner="off", backing=WORST),
        edge_planner(),
        value(),
        edge_policy(),
        *available_locals(*_POLICIES),
        at_full_speed("longest_queue"),
        BOUND,
    ]


EXPERIMENT = Experiment(
    name="guided",
    title="Decisions worth flying, whatever the LLM",
    summary="mode guided with the LLM at hand, with one that draws or names the worst, and without the planner",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "velocity", "prompt_tokens", "llm_trust"),
    figures=(
        FigureSpec("guided", "curves", LOSS_CURVES, "Lost packets and loss events, per step and cumulative."),
        FigureSpec("guided_totals", "bars", LOSSES, "Lost packets and loss events of a mission."),
    ),
    references=("edge_planner", "eof", "wqcs"),
    pairs=(
        ("guided", "max_gain"),
        ("guided", "madqn"),
        ("guided", "mappo"),
        ("guided_chance", "value_reach"),
        ("guided_worst", "value_reach"),
        ("guided_alone_chance", "value_reach"),
        ("guided_alone_worst", "value_reach"),
    ),
    notes=(
        "`LLM draws` answers a uniform draw of the letters offered, `names the worst` the emptiest queue at its "
        "fastest velocity.",
        "The bound knows every arrival beforehand, which no scheme does; the line is the proven lower bound.",
    ),
)
