"""Reasons why a decision is not the LLM's, and the classes of these reasons."""

from typing import Literal

Reason = Literal[
    "mode_value",
    "mode_policy",
    "no_candidate",
    "llm_loading",
    "llm_unavailable",
    "llm_timeout",
    "llm_status",
    "llm_error",
    "answer_format",
    "answer_sensor",
    "answer_velocity",
    "answer_reserved",
    "rule_reach",
    "rule_battery",
    "llm_busy",
    "critic_timeout",
]

# The LLM gets no prompt.
LLM_NOT_ASKED: frozenset[Reason] = frozenset(
    {"mode_value", "mode_policy", "no_candidate", "llm_loading", "llm_unavailable", "llm_busy"}
)
# The LLM gets a prompt and gives no usable answer. For reasons of neither class, its answer is usable but overridden.
LLM_FAILURES: frozenset[Reason] = frozenset(
    {"llm_timeout", "llm_status", "llm_error", "answer_format", "answer_sensor", "answer_velocity"}
)
