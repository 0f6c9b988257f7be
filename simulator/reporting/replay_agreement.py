"""How far a replayed mission's decisions are those that were logged, and what either cost; ``replay.json``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from shared.wire import MissionSpec
from simulator.records.decision import Decision, asked_llm
from simulator.records.record import Record
from simulator.records.statistics import mean
from simulator.records.summary import BySource, RoundTrips, round_trips, told_sources

# Velocities so far apart still agree, m/s.
CLOSE_MPS = 1
# What an answer takes where the LLM's server did not say: two numbers and a space.
_ANSWER_TOKENS = 5


class Compared(Record):
    """One logged decision and what the edge decided when asked again.

    ``fed_back``: the decision is the same, so the logged outcome is its outcome too, and the edge was told it. The
    replayed decision has no outcome of its own.
    """

    logged: Decision
    replayed: Decision
    fed_back: bool = False

    @property
    def same(self) -> bool:
        """The same sensor at the same velocity."""
        return (self.logged.sensor_id, self.logged.velocity) == (self.replayed.sensor_id, self.replayed.velocity)

    def line(self) -> str:
        """As JSON, without what was never observed."""
        return self.model_dump_json(exclude={"replayed": {"failed", "collected", "lost_packets", "cost"}})


class Agreement(Record):
    """Percentages of ``decisions``; ``velocity_pct`` within 1 m/s, ``both_pct`` sensor and velocity at once."""

    decisions: int
    sensor_pct: float | None
    velocity_pct: float | None
    both_pct: float | None


class Side(Record):
    """One of the two missions: who decided, and means over the decisions that the edge took.

    ``prompt_tokens`` are the edge's count, ``llm_`` the LLM server's own, ``llm_new_tokens`` those not read from its
    prefix cache. ``cost_usd`` is the estimate for all decisions together; None where there are no prices to go by.
    """

    by_source: BySource
    by_reason: dict[str, int]
    model: str | None
    prompt_tokens: float | None
    llm_prompt_tokens: float | None
    llm_new_tokens: float | None
    llm_completion_tokens: float | None
    rtt_ms: RoundTrips
    llm_asked: int
    cost_usd: float | None


class ReplaySummary(Record):
    """``replay.json``. ``spec`` is what the mission was asked again with, ``changed`` where it differs from the log.

    ``unasked`` are logged decisions that the edge was not asked again, because the replay ended early.
    """

    run: str
    edge: str
    mission_id: str
    version: str
    command: str
    spec: MissionSpec
    changed: dict[str, tuple[Any, Any]]
    decisions: int
    unasked: int
    outcomes_fed_back: int
    agreement: Agreement
    by_source: dict[str, Agreement]
    logged: Side
    replayed: Side


@dataclass(frozen=True)
class Prices:
    """US dollars a million prompt, cached prompt, and completion tokens."""

    prompt: float
    cached: float
    completion: float

    def of(self, decision: Decision) -> float:
        """What a decision's call to the LLM would cost, 0 where it was not asked.

        By the server's token counts where it told them; otherwise by the edge's, nothing cached, and a usual answer.
        """
        tokens = decision.tokens
        if tokens is None or not asked_llm(decision):
            return 0.0
        prompt = tokens.server_prompt if tokens.server_prompt is not None else tokens.prompt
        cached = tokens.cached or 0
        completion = tokens.completion if tokens.completion is not None else _ANSWER_TOKENS
        fresh = (prompt - cached) * self.prompt
        return (fresh + cached * self.cached + completion * self.completion) / 1e6


def agreement(compared: Sequence[Compared]) -> Agreement:
    """Over all of them."""
    sensor = [c.logged.sensor_id == c.replayed.sensor_id for c in compared]
    velocity = [abs(c.logged.velocity - c.replayed.velocity) <= CLOSE_MPS for c in compared]
    both = [s and v for s, v in zip(sensor, velocity, strict=True)]
    return Agreement(decisions=len(compared), sensor_pct=_pct(sensor), velocity_pct=_pct(velocity), both_pct=_pct(both))


def by_source(compared: Sequence[Compared]) -> dict[str, Agreement]:
    """By who decided when asked again."""
    sources = Counter(c.replayed.source for c in compared)
    return {name: agreement([c for c in compared if c.replayed.source == name]) for name, _ in sources.most_common()}


def side(decisions: Sequence[Decision], prices: Prices | None) -> Side:
    """Of one mission; without prices, the cost is what its edge said."""
    tokens = [d.tokens for d in decisions if d.tokens is not None]
    told = [t for t in tokens if t.server_prompt is not None]
    return Side(
        by_source=BySource.model_validate(Counter(d.source for d in decisions)),
        by_reason=dict(sorted(Counter(d.reason for d in decisions if d.reason is not None).items())),
        model=next((d.model for d in reversed(decisions) if d.model), None),
        prompt_tokens=mean([t.prompt for t in tokens]),
        llm_prompt_tokens=mean([t.server_prompt for t in told if t.server_prompt is not None]),
        llm_new_tokens=mean([t.server_prompt - (t.cached or 0) for t in told if t.server_prompt is not None]),
        llm_completion_tokens=mean([t.completion for t in told if t.completion is not None]),
        rtt_ms=round_trips(decisions),
        llm_asked=sum(map(asked_llm, decisions)),
        cost_usd=_cost(decisions, prices),
    )


def _cost(decisions: Sequence[Decision], prices: Prices | None) -> float | None:
    if prices is not None:
        return sum(map(prices.of, decisions))
    said = [d.tokens.cost_usd for d in decisions if d.tokens is not None and d.tokens.cost_usd is not None]
    return sum(said) if said else None


def _pct(held: Sequence[bool]) -> float | None:
    return 100 * sum(held) / len(held) if held else None


def show(summary: ReplaySummary, console: Console) -> None:
    """Two short tables: the missions side by side, and where they agree."""
    sides = Table("", "logged", "replayed", title=f"{summary.decisions} decisions asked again")
    for name, told in _ROWS.items():
        sides.add_row(name, told(summary.logged), told(summary.replayed))
    console.print(sides)
    agreed = Table("decided by", "decisions", "same sensor", f"velocity within {CLOSE_MPS} m/s", "both")
    for name, part in (("all", summary.agreement), *summary.by_source.items()):
        shares = (part.sensor_pct, part.velocity_pct, part.both_pct)
        agreed.add_row(name, str(part.decisions), *(_told(share, "{:.0f} %") for share in shares))
    console.print(agreed)
    different = summary.decisions - summary.outcomes_fed_back
    if different:
        console.print(
            f"{different} decisions were not fed back: they differ from those flown, so nobody knows what they "
            "would have cost.",
            highlight=False,
        )


def _told(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


_ROWS: dict[str, Callable[[Side], str]] = {
    "LLM": lambda s: s.model or "-",
    "decided by": lambda s: told_sources(s.by_source),
    "prompt tokens": lambda s: _told(s.prompt_tokens, "{:.0f}"),
    "the LLM's own count": lambda s: _told(s.llm_prompt_tokens, "{:.0f}"),
    "of them new, not cached": lambda s: _told(s.llm_new_tokens, "{:.0f}"),
    "answer tokens": lambda s: _told(s.llm_completion_tokens, "{:.1f}"),
    "round trip p50, ms": lambda s: _told(s.rtt_ms.p50, "{:.0f}"),
    "round trip p99, ms": lambda s: _told(s.rtt_ms.p99, "{:.0f}"),
    "estimated cost, US$": lambda s: _told(s.cost_usd, "{:.6f}"),
}
