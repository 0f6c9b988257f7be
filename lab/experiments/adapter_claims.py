"""The paper's statements, tested by mode llm with the adapter: losses by step, k, attention, tokens, fairness."""

from __future__ import annotations

from lab.experiments.measures import LOSS_CURVES, LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.result import Sweep
from lab.experiments.schemes import Scheme, adapted_chance, adapted_llm, available_locals

_TOP_K = 5
_OTHER_KS = (1, 2, 3, 7, 10)


def _adapted(name: str, label: str, top_k: int = _TOP_K, attention: str = "on") -> Scheme:
    return adapted_llm(name, f"with the adapter, {label}", top_k=top_k, attention=attention)


def _schemes(setup: Setup) -> list[Scheme]:
    return [
        _adapted("llm", f"k = {_TOP_K}"),
        *(_adapted(f"k{k}", f"k = {k}", top_k=k) for k in _OTHER_KS),
        _adapted("llm_all", "no attention", attention="off"),
        adapted_chance(),
        *available_locals("eof", "wqcs", "madqn_paper", "mappo", "random"),
    ]


EXPERIMENT = Experiment(
    name="adapter-claims",
    title="The paper's statements, with the adapter",
    summary="mode llm with the adapter: what the paper states of losses by step, k, attention, tokens and fairness",
    schemes=_schemes,
    measures=(
        *LOSSES,
        "jain",
        "jain_scheduled",
        "state_tokens",
        "state_uncompressed",
        "state_saved_pct",
        "prompt_tokens",
        "prompt_uncompressed",
        "prompt_saved_pct",
        "llm_decided_pct",
    ),
    figures=(
        FigureSpec("adapter_claims", "curves", LOSS_CURVES, "Lost packets and loss events, by step."),
        FigureSpec("adapter_claims_k", "sweep", ("lost_packets",), "Lost packets over k, with the adapter."),
    ),
    references=("llm",),
    paired_measures=("lost_packets",),
    sweep=Sweep(label="sensors kept, k", at={"llm": float(_TOP_K)} | {f"k{k}": float(k) for k in _OTHER_KS}),
    notes=(
        "Rows are shuffled; neither planner, verifier nor critic takes part. The rows show what the fleet's belief and "
        "its learned links foresee, which the paper's rows do not.",
        "The adapter was trained on 1 to 10 rows: up to five have four velocities each, more have two.",
    ),
)
