"""With and without attention (the paper finds no significant difference in losses)."""

from __future__ import annotations

from lab.experiments.measures import LOSS_CURVES, LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import Scheme, llm, over_edge, value_as_written


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        llm(),
        over_edge("llm_random_start", "mode llm, k = 5, random start", init="random"),
        over_edge("llm_all", "mode llm, no attention", attention="off"),
        value_as_written(),
        value_as_written("value_random_start", "mode value, paper's view, random start", init="random"),
    ]


EXPERIMENT = Experiment(
    name="attention",
    title="With and without attention",
    summary="mode llm with attention (k = 5) and without, from the shipped and from a random start",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "state_tokens", "prompt_tokens", "llm_decided_pct"),
    figures=(
        FigureSpec(
            "attention", "curves", LOSS_CURVES, "With attention (k = 5) and, where an LLM flies, without: what is lost."
        ),
        FigureSpec(
            "attention_totals",
            "bars",
            LOSSES,
            "With attention (k = 5) and, where an LLM flies, without: a mission's losses.",
        ),
    ),
    pairs=(
        ("llm", "llm_all"),
        ("llm_random_start", "llm_all"),
        ("llm", "llm_random_start"),
        ("value", "value_random_start"),
    ),
    paired_measures=(*LOSSES, "state_tokens", "prompt_tokens"),
    notes=(
        "Random start: attention and velocity modules untrained, as the paper's algorithm suggests; else from the "
        "checkpoint that ships. Without attention every admissible sensor is in the prompt, in the request's order.",
        "A paired difference whose interval holds 0 is no proof that there is none: read its width.",
    ),
)
