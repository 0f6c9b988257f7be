"""Ablation of the modules' inputs: features of the paper or with reach, each UAV's reports or the fleet's belief."""

from __future__ import annotations

from lab.experiments.measures import LOSS_CURVES, LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import OFF, Scheme, llm, over_edge, value, value_as_written


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        value_as_written(),
        over_edge("value_fleet", "mode value, fleet's belief", mode="value", features="paper", backing=OFF),
        over_edge("value_ahead", "mode value, reach", mode="value", belief="reported", backing=OFF),
        value().model_copy(update={"label": "mode value, reach and fleet's belief"}),
        llm(),
        over_edge("llm_reach", "mode llm, features reach", features="reach"),
        over_edge("llm_fleet", "mode llm, reach and fleet's belief", features="reach", belief="fleet"),
    ]


EXPERIMENT = Experiment(
    name="ablation-features",
    title="What the modules see",
    summary="the paper's features, those of an edge that knows the trajectory (reach), and the fleet's belief",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "velocity", "llm_decided_pct"),
    figures=(
        FigureSpec("ablation_features", "curves", LOSS_CURVES, "Losses by the features that the modules see."),
        FigureSpec(
            "ablation_features_totals", "bars", LOSSES, "Losses of a mission by the features that the modules see."
        ),
    ),
    pairs=(
        ("value_fleet", "value"),
        ("value_ahead", "value"),
        ("value_reach", "value_ahead"),
        ("llm_reach", "llm"),
        ("llm_fleet", "llm_reach"),
    ),
    notes=("All from the checkpoint that ships for these features.",),
)
