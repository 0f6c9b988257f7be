"""``replay.json``: the agreement of a replayed mission with the logged one, and the costs of both."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from shared.wire.schemas import MissionSpec
from simulator.records.decision import Decision, Record, mean, queried_llm
from simulator.records.summary import BySource, RoundTrips, round_trips, sources_text

# The largest difference of velocities that agree, m/s.
CLOSE_MPS = 1


class Compared(Record):
    """One logged decision and its replay.

    ``fed_back``: the replayed decision is the same, so the logged outcome is valid for it and was sent to the edge. A
    replayed decision has no outcome of its own.
    """

    logged: Decision
    replayed: Decision
    fed_back: bool = False

    @property
    def same(self) -> bool:
        """Whether the sensor and the velocity are the same."""
        return (self.logged.sensor_id, self.logged.velocity) == (self.replayed.sensor_id, self.replayed.velocity)

    def line(self) -> str:
        """As JSON, without the outcome of the replayed decision, which was never observed."""
        return self.model_dump_json(exclude={"replayed": {"failed", "collected", "lost_packets", "cost"}})


class ReplayAgreement(Record):
    """Percentages of ``decisions`` that agree; in velocity within 1 m/s, ``both_pct`` in sensor and velocity."""

    decisions: int
    sensor_pct: float | None
    velocity_pct: float | None
    both_pct: float | None


class Side(Record):
    """One of the two missions: the sources of its decisions, and means over the edge's decisions.

    ``prompt_tokens`` is the edge's count. Fields with ``llm_`` are the LLM server's counts, and ``llm_new_tokens`` are
    the tokens not read from its prefix cache. ``cost_usd`` is the edge's estimate for all decisions together,
    by its prices (``AICVDS_PRICE_INPUT`` and others).
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
    """``replay.json``. ``spec`` is the replayed mission's, ``changed`` are its differences from the logged one.

    ``unasked`` is the number of logged decisions without a replay, because it ended early.
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
    agreement: ReplayAgreement
    by_source: dict[str, ReplayAgreement]
    logged: Side
    replayed: Side


def agreement(compared: Sequence[Compared]) -> ReplayAgreement:
    """The agreement over all pairs."""
    sensor = [c.logged.sensor_id == c.replayed.sensor_id for c in compared]
    velocity = [abs(c.logged.velocity - c.replayed.velocity) <= CLOSE_MPS for c in compared]
    both = [s and v for s, v in zip(sensor, velocity, strict=True)]
    return ReplayAgreement(
        decisions=len(compared), sensor_pct=_pct(sensor), velocity_pct=_pct(velocity), both_pct=_pct(both)
    )


def by_source(compared: Sequence[Compared]) -> dict[str, ReplayAgreement]:
    """The agreement by source of the replayed decision."""
    sources = Counter(c.replayed.source for c in compared)
    return {name: agreement([c for c in compared if c.replayed.source == name]) for name, _ in sources.most_common()}


def side(decisions: Sequence[Decision]) -> Side:
    """The statistics of one mission."""
    tokens = [d.tokens for d in decisions if d.tokens is not None]
    counted = [t for t in tokens if t.server_prompt is not None]
    costs = [t.cost_usd for t in tokens if t.cost_usd is not None]
    return Side(
        by_source=BySource.model_validate(Counter(d.source for d in decisions)),
        by_reason=dict(sorted(Counter(d.reason for d in decisions if d.reason is not None).items())),
        model=next((d.model for d in reversed(decisions) if d.model), None),
        prompt_tokens=mean([t.prompt for t in tokens]),
        llm_prompt_tokens=mean([t.server_prompt for t in counted if t.server_prompt is not None]),
        llm_new_tokens=mean([t.server_prompt - (t.cached or 0) for t in counted if t.server_prompt is not None]),
        llm_completion_tokens=mean([t.completion for t in counted if t.completion is not None]),
        rtt_ms=round_trips(decisions),
        llm_asked=sum(map(queried_llm, decisions)),
        cost_usd=sum(costs) if costs else None,
    )


def _pct(agree: Sequence[bool]) -> float | None:
    return 100 * sum(agree) / len(agree) if agree else None


def show(summary: ReplaySummary, console: Console) -> None:
    """Print two tables: the missions side by side, and their agreement."""
    sides = Table("", "logged", "replayed", title=f"{summary.decisions} decisions replayed")
    for name, cell in _ROWS.items():
        sides.add_row(name, cell(summary.logged), cell(summary.replayed))
    console.print(sides)
    agreed = Table("decided by", "decisions", "same sensor", f"velocity within {CLOSE_MPS} m/s", "both")
    for name, part in (("all", summary.agreement), *summary.by_source.items()):
        shares = (part.sensor_pct, part.velocity_pct, part.both_pct)
        agreed.add_row(name, str(part.decisions), *(_cell(share, "{:.0f} %") for share in shares))
    console.print(agreed)
    different = summary.decisions - summary.outcomes_fed_back
    if different:
        console.print(
            f"{different} decisions were not fed back: they differ from those flown, so their cost is unknown.",
            highlight=False,
        )


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


_ROWS: dict[str, Callable[[Side], str]] = {
    "LLM": lambda s: s.model or "-",
    "decided by": lambda s: sources_text(s.by_source),
    "prompt tokens": lambda s: _cell(s.prompt_tokens, "{:.0f}"),
    "the LLM's own count": lambda s: _cell(s.llm_prompt_tokens, "{:.0f}"),
    "of them new, not cached": lambda s: _cell(s.llm_new_tokens, "{:.0f}"),
    "answer tokens": lambda s: _cell(s.llm_completion_tokens, "{:.1f}"),
    "round trip p50, ms": lambda s: _cell(s.rtt_ms.p50, "{:.0f}"),
    "round trip p99, ms": lambda s: _cell(s.rtt_ms.p99, "{:.0f}"),
    "estimated cost, US$": lambda s: _cell(s.cost_usd, "{:.6f}"),
}
