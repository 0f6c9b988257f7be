"""Every experiment by name, in the order in which `all` makes them."""

from __future__ import annotations

from simulator.experiments import (
    ablation_features,
    ablation_prompt,
    aoi,
    attention,
    fairness,
    guided,
    jailbreak,
    latency,
    llm_models,
    obedience,
    scenarios,
    scheduler,
    tokens,
    top_k,
)
from simulator.experiments.plan import Experiment

EXPERIMENTS: dict[str, Experiment] = {
    module.EXPERIMENT.name: module.EXPERIMENT
    for module in (
        scheduler,
        guided,
        attention,
        top_k,
        tokens,
        latency,
        fairness,
        ablation_prompt,
        ablation_features,
        llm_models,
        obedience,
        jailbreak,
        aoi,
        scenarios,
    )
}
ALL = "all"
