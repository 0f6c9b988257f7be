"""Ablation of the prompt: the order of its rows, and its experiences."""

from __future__ import annotations

from itertools import product

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import Scheme, over_edge

_ORDERS, _EXPERIENCES = ("score", "shuffled"), (0, 6, 30)
_BASE = ("score", 6)


def _scheme(order: str, experiences: int) -> Scheme:
    prompt = {"format": "csv", "order": order, "experiences": experiences}
    label = f"{'best first' if order == 'score' else 'shuffled'}, {experiences} experiences"
    return over_edge(f"{order}_{experiences}", label, prompt=prompt)


def _schemes(setup: Setup) -> list[Scheme]:
    cells = product(_ORDERS, _EXPERIENCES)
    # A quick run has only the schemes that differ from the base in one option.
    return [_scheme(*cell) for cell in cells if not setup.quick or _differences(cell) <= 1]


def _differences(cell: tuple[str, int]) -> int:
    return sum(ours != base for ours, base in zip(cell, _BASE, strict=True))


EXPERIMENT = Experiment(
    name="ablation-prompt",
    title="What of the prompt carries the decision",
    summary="rows best first or shuffled; 0, 6, 30 experiences",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "state_tokens", "prompt_tokens", "rtt_p50", "llm_decided_pct"),
    figures=(
        FigureSpec("ablation_prompt", "bars", LOSSES, "Losses by the rows' order and the experiences kept."),
        FigureSpec("ablation_prompt_cost", "bars", ("prompt_tokens", "rtt_p50"), "What each prompt costs."),
    ),
    references=("_".join(map(str, _BASE)),),
    notes=("Mode llm, k = 5. Experiences are those kept at most; the older half is dropped when there are more.",),
)
