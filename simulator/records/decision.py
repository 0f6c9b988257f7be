"""The base of every record that a run leaves on disk, and one decision of a flight: a line of ``decisions.jsonl``."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from shared.wire.reasons import LLM_FAILURES
from shared.wire.schemas import Candidate, Tokens

DecidedBy = Literal["llm", "guided", "value", "policy", "onboard"]


class Record(BaseModel):
    """A record in a file; files of older versions may lack fields, and those of newer versions may have more."""

    model_config = ConfigDict(frozen=True, extra="ignore")


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


def visits_per_sensor(decisions: Iterable[Decision], sensors: int) -> list[int]:
    """The number of successful visits of each of ``sensors`` sensors."""
    served = Counter(d.sensor_id for d in decisions if not d.failed)
    return [served[j] for j in range(sensors)]


def jain_index(values: Sequence[float]) -> float | None:
    """Jain's fairness index, from 1/n (one value has all) to 1 (all equal); ``None`` if every value is 0."""
    squares = sum(v * v for v in values)
    return sum(values) ** 2 / (len(values) * squares) if squares else None


def mean(values: Sequence[float]) -> float | None:
    """The mean; ``None`` for an empty sequence."""
    return sum(values) / len(values) if values else None


def percentile(values: list[float], q: float) -> float | None:
    """The ``q``-th percentile; ``None`` for an empty list."""
    return float(np.percentile(values, q)) if values else None
