"""The number k of sensors in the prompt (the paper: k = 3 is worse than 5, more than 5 is no better)."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.result import Sweep
from lab.experiments.schemes import Scheme, over_edge

_TOP_KS = (1, 2, 3, 5, 7, 10)
_TOP_KS_QUICK = (1, 3, 5, 10)


def _schemes(setup: Setup) -> list[Scheme]:
    return [over_edge(f"k{k}", f"k = {k}", top_k=k) for k in (_TOP_KS_QUICK if setup.quick else _TOP_KS)]


EXPERIMENT = Experiment(
    name="top-k",
    title="How many sensors to keep",
    summary="k = 1, 2, 3, 5, 7, 10 sensors in the prompt: losses and tokens",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "state_tokens", "prompt_tokens", "llm_decided_pct"),
    figures=(
        FigureSpec(
            "top_k", "sweep", (*LOSSES, "state_tokens"), "Losses and the state block's tokens over k, mode llm."
        ),
    ),
    references=("k5",),
    sweep=Sweep(label="sensors kept, k", at={f"k{k}": float(k) for k in _TOP_KS}),
    notes=("Often fewer than k sensors are heard, free and charged; then all of those are offered.",),
)
