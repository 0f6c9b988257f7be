"""Every experiment by name, in the order of `all`: the paper's figures and tables, and those beyond it.

Each experiment is one module of this room. Its flights are flown once and stored, and experiments share them.
"""

from __future__ import annotations

from lab.experiments import (
    ablation_features,
    ablation_prompt,
    adapter,
    adapter_claims,
    adapter_experiences,
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
    sensor_uplinks,
    tokens,
    top_k,
    unknown_worlds,
)
from lab.experiments.plan import Experiment

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
        adapter,
        adapter_claims,
        adapter_experiences,
        llm_models,
        obedience,
        jailbreak,
        aoi,
        scenarios,
        unknown_worlds,
        sensor_uplinks,
    )
}
ALL = "all"
