"""The embedded LLM with its adapter and as it is, in known and unknown worlds."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import (
    ADAPTED,
    CHANCE,
    Scheme,
    adapted_chance,
    adapted_llm,
    at_full_speed,
    available_locals,
    edge_planner,
    guided,
    llm,
    value,
)

_HEURISTICS = ("longest_queue", "queue_and_channel", "max_gain", "nearest")


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        adapted_llm(),
        llm(),
        adapted_chance(),
        guided("guided_adapted", "guided, with the adapter", backing=ADAPTED),
        guided("guided_alone_adapted", "guided, no planner, with the adapter", planner="off", backing=ADAPTED),
        guided("guided_alone_chance", "guided, no planner, LLM draws", planner="off", backing=CHANCE),
        value(),
        edge_planner(),
        *available_locals("eof", "wqcs", *_HEURISTICS),
        *map(at_full_speed, _HEURISTICS),
    ]


EXPERIMENT = Experiment(
    name="adapter",
    title="The LLM with an adapter",
    summary="mode llm with the adapter of `lab distill` and without, beside draws, values, planner and heuristics",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "llm_decided_pct", "rtt_p50", "llm_trust"),
    figures=(FigureSpec("adapter", "bars", ("lost_packets",), "Lost packets of a mission by scenario."),),
    references=("eof", "wqcs"),
    pairs=(("llm_adapted", "llm"), ("llm_adapted", "value_reach"), ("guided_adapted", "edge_planner")),
    paired_measures=("lost_packets",),
    worlds=("paper", "shadowed", "field", "stress", "pipeline", "dense"),
    heuristics=tuple(name + speed for name in _HEURISTICS for speed in ("", "_fast")) + ("eof", "wqcs"),
    notes=(
        "With the adapter, mode llm has the compact prompt, the fleet's belief and the features `reach`. Its rows are "
        "shuffled, and neither planner, verifier nor critic takes part. Without it, the prompt is the paper's. "
        "The LLM's own weights stay as they are; the adapter was trained on the planner's decisions in worlds of other "
        "seeds. What it decides is learned before the flight, not in the prompt's context.",
    ),
)
