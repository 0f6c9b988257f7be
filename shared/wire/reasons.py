"""Reasons why a decision is not the LLM's, and the classes of these reasons."""

from typing import Literal, get_args

_NotAsked = Literal["mode_value", "mode_policy", "no_candidate", "llm_loading", "llm_unavailable", "llm_busy"]
_Failure = Literal["llm_timeout", "llm_status", "llm_error", "answer_format", "answer_sensor", "answer_velocity"]
Reason = Literal[_NotAsked, _Failure, "answer_reserved", "rule_reach", "rule_battery", "critic_timeout"]

# The LLM gets no prompt.
LLM_NOT_ASKED: frozenset[Reason] = frozenset(get_args(_NotAsked))
# The LLM gets a prompt and gives no usable answer. For reasons of neither class, its answer is usable but overridden.
LLM_FAILURES: frozenset[Reason] = frozenset(get_args(_Failure))
