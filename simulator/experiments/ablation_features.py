"""What the modules see: the paper's five features, or also what the trajectory brings in reach."""

from __future__ import annotations

from simulator.experiments.measures import LOSS_CURVES, LOSSES
from simulator.experiments.plan import Drawing, Experiment, Setup
from simulator.experiments.schemes import Scheme, llm, over_edge, value, value_reach


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        value(),
        value_reach(),
        llm(),
        over_edge("llm_reach", "mode llm, features reach", features="reach"),
    ]


EXPERIMENT = Experiment(
    name="ablation-features",
    title="What the modules see",
    summary="the paper's features, and those of an edge that knows the trajectory (reach)",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "velocity", "llm_decided_pct"),
    drawings=(
        Drawing("ablation_features", "curves", LOSS_CURVES, "Losses by the features that the modules see."),
        Drawing(
            "ablation_features_totals", "bars", LOSSES, "Losses of a mission by the features that the modules see."
        ),
    ),
    pairs=(("value_reach", "value"), ("llm_reach", "llm")),
    notes=("Both from the checkpoint that ships for these features.",),
)
