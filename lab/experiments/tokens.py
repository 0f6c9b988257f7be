"""Tokens with and without attention (the paper: the state block shrinks from 213.7 to 106.8)."""

from __future__ import annotations

from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import Scheme, edge_policy, guided, llm, over_edge, value

_STATE = ("state_tokens", "state_uncompressed")
_PROMPT = ("prompt_tokens", "prompt_uncompressed")


def _schemes(setup: Setup) -> list[Scheme]:
    return [llm(), over_edge("llm_all", "mode llm, no attention", attention="off"), guided(), value(), edge_policy()]


EXPERIMENT = Experiment(
    name="tokens",
    title="Tokens a decision",
    summary="state-block and prompt tokens a decision, with and without attention",
    schemes=_schemes,
    measures=(*_STATE, "state_saved_pct", *_PROMPT, "prompt_saved_pct", "cached_tokens", "completion_tokens"),
    figures=(
        FigureSpec(
            "tokens_state", "bars", _STATE, "Tokens of the state block a decision, as sent and as it would be whole."
        ),
        FigureSpec(
            "tokens_prompt", "bars", _PROMPT, "Tokens of the whole prompt a decision, as sent and with a whole state."
        ),
    ),
    pairs=(("llm", "llm_all"),),
    paired_measures=("state_tokens", "prompt_tokens"),
    notes=(
        "Tokens are o200k_base's (GPT-4o-mini's), but for those said to be the model's own. `Without attention` is the "
        "counterfactual of the same decision: every reported sensor, battery included. It saves by masks as well as by "
        "attention: sensors that are not heard, reserved or flat leave the prompt too. What masks alone leave is "
        "the row `mode llm, no attention`; what attention adds to them is the paired difference to it.",
        "Modes value and the edge's policy send no prompt; theirs is the one that would have been sent.",
    ),
)
