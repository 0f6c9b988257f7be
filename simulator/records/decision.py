"""One decision of a flight: one line of ``decisions.jsonl``."""

from typing import Literal

from shared.wire.reasons import LLM_FAILURES
from shared.wire.schemas import Candidate, Tokens
from simulator.records.record import Record

DecidedBy = Literal["llm", "guided", "value", "policy", "onboard"]


class Decision(Record):
    """One decision and its outcome.

    ``position`` is the UAV's position at the decision, metres. ``source`` is ``onboard`` for a decision of the UAV
    itself; then ``decision_id``, ``tokens``, ``deadline_ms`` and ``rtt_ms`` are ``null``, and ``attempts``,
    ``request_bytes``, ``response_bytes`` and ``attention_bytes`` are 0. ``rtt_ms`` includes retries. ``lost_packets``
    and ``cost`` are this UAV's share. ``trust`` is the weight of each adviser before a decision of mode ``guided``;
    the weights sum to 1.
    """

    step: int
    uav_id: int
    position: tuple[float, float]
    sensor_id: int
    velocity: int
    source: DecidedBy
    reason: str | None = None
    model: str | None = None
    decision_id: str | None = None
    top_k: list[Candidate] = []
    trust: dict[str, float] = {}
    tokens: Tokens | None = None
    latency_ms: dict[str, float] = {}
    deadline_ms: int | None = None
    rtt_ms: float | None = None
    attempts: int = 0
    request_bytes: int = 0
    response_bytes: int = 0
    attention_bytes: int = 0
    failed: bool = False
    collected: int = 0
    lost_packets: int = 0
    cost: float = 0.0


def queried_llm(decision: Decision) -> bool:
    """Whether the LLM was queried for it, with a usable answer or not."""
    if decision.source in ("llm", "guided") or decision.reason in LLM_FAILURES:
        return True
    return decision.tokens is not None and decision.tokens.server_prompt is not None
