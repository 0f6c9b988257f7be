"""``summary.json``: the result of one mission."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Protocol

from shared.wire import Tokens, Uplink
from simulator.records.decision import Decision, asked_llm
from simulator.records.record import Record
from simulator.records.statistics import jain_index, mean, percentile, visits_per_sensor

LATE_SLACK_MS = 50.0


class BySource(Record):
    """Decisions, by who took them; ``value`` is what the edge's modules learned, ``policy`` its LLM-free policy."""

    llm: int = 0
    guided: int = 0
    value: int = 0
    policy: int = 0
    onboard: int = 0

    def present(self) -> dict[str, int]:
        """Those who took any, most decisions first."""
        return dict(sorted(((k, n) for k, n in self.model_dump().items() if n), key=lambda item: -item[1]))


def told_sources(by_source: BySource) -> str:
    """Who decided, as people write it: ``87 llm, 3 policy``."""
    return ", ".join(f"{count} {name}" for name, count in by_source.present().items()) or "none"


class TokenSummary(Record):
    """Means over the decisions that the edge took, ``null`` when it took none or did not say.

    ``cached_pct`` is what the LLM server read from its prefix cache, of the prompt tokens that it counted itself.
    """

    prompt_mean: float | None = None
    uncompressed_mean: float | None = None
    saved_pct: float | None = None
    cached_mean: float | None = None
    cached_pct: float | None = None
    state_mean: float | None = None
    state_uncompressed_mean: float | None = None
    state_saved_pct: float | None = None


class RoundTrips(Record):
    """Percentiles over the decisions that the edge took, milliseconds."""

    p50: float | None = None
    p99: float | None = None


class Flown(Record):
    """The mission's facts that no single decision holds.

    ``steps`` were asked for and ``steps_flown`` flown; ``policy`` is ``edge`` or a local policy's name;
    ``deadline_ms`` is what the edge said last, or what it was asked for. ``uplink`` says how much of a report was sent,
    ``null`` where no edge was asked.
    """

    scenario: str
    seed: int
    steps: int
    steps_flown: int
    uavs: int
    sensors: int
    policy: str
    edge: str | None
    uplink: Uplink | None = None
    mission_id: str
    mode: str | None
    model: str | None
    deadline_ms: int | None
    interrupted: bool
    started_at: datetime
    duration_s: float
    version: str
    command: str


class Summary(Flown):
    """``summary.json``.

    ``lost_packets`` and ``loss_events`` are by policy: ``aic_vds`` (or the local policy that was flown), ``eof``
    and ``wqcs``, all over ``steps_flown`` steps of one world. ``late`` counts decisions whose round trip took more than
    their deadline + 50 ms. ``jain`` is Jain's index of the sensors' served visits, ``null`` when none was served;
    ``failures`` are failed transmissions; ``llm_asked`` counts decisions for which the LLM was asked, in vain or not.
    ``uplink_bytes_mean`` is a decision's request, ``attention_bytes_mean`` what its UAV was sent to prune by.
    """

    decisions: int
    by_source: BySource
    by_reason: dict[str, int]
    lost_packets: dict[str, int]
    loss_events: dict[str, int]
    failures: int
    late: int
    tokens: TokenSummary
    rtt_ms: RoundTrips
    uplink_bytes_mean: float | None
    attention_bytes_mean: float | None = None
    jain: float | None
    llm_asked: int = 0


class Tally(Protocol):
    """One step's losses, as ``simulator.world.StepTally`` counts them."""

    @property
    def failures(self) -> int: ...
    @property
    def overflows(self) -> int: ...
    @property
    def lost_packets(self) -> int: ...


def summarise(flown: Flown, decisions: Sequence[Decision], tallies: Mapping[str, Sequence[Tally]]) -> Summary:
    """The summary of one mission.

    Args:
        flown: the mission's facts.
        decisions: every decision of its ``steps_flown`` steps.
        tallies: per policy, one tally a step flown.
    """
    from_edge = [d for d in decisions if d.rtt_ms is not None]
    return Summary(
        **flown.model_dump(),
        decisions=len(decisions),
        by_source=BySource.model_validate(Counter(d.source for d in decisions)),
        by_reason=dict(sorted(Counter(d.reason for d in decisions if d.reason is not None).items())),
        lost_packets={name: int(sum(t.lost_packets for t in tally)) for name, tally in tallies.items()},
        loss_events={name: int(sum(t.failures + t.overflows for t in tally)) for name, tally in tallies.items()},
        failures=sum(d.failed for d in decisions),
        late=sum(_is_late(d) for d in from_edge),
        tokens=_tokens([d.tokens for d in from_edge if d.tokens is not None]),
        rtt_ms=round_trips(decisions),
        uplink_bytes_mean=mean([d.request_bytes for d in from_edge]),
        attention_bytes_mean=mean([d.attention_bytes for d in from_edge]),
        jain=jain_index(visits_per_sensor(decisions, flown.sensors)),
        llm_asked=sum(asked_llm(d) for d in decisions),
    )


def round_trips(decisions: Iterable[Decision]) -> RoundTrips:
    """Over the decisions that the edge took."""
    trips = [d.rtt_ms for d in decisions if d.rtt_ms is not None]
    return RoundTrips(p50=percentile(trips, 50), p99=percentile(trips, 99))


def _is_late(decision: Decision) -> bool:
    if decision.rtt_ms is None or decision.deadline_ms is None:
        return False
    return decision.rtt_ms > decision.deadline_ms + LATE_SLACK_MS


def _tokens(counts: list[Tokens]) -> TokenSummary:
    prompt, uncompressed = mean([t.prompt for t in counts]), mean([t.uncompressed for t in counts])
    state, state_uncompressed = mean([t.state for t in counts]), mean([t.state_uncompressed for t in counts])
    return TokenSummary(
        prompt_mean=prompt,
        uncompressed_mean=uncompressed,
        saved_pct=_saved_pct(prompt, uncompressed),
        cached_mean=mean([t.cached for t in counts if t.cached is not None]),
        cached_pct=_cached_pct(counts),
        state_mean=state,
        state_uncompressed_mean=state_uncompressed,
        state_saved_pct=_saved_pct(state, state_uncompressed),
    )


def _cached_pct(counts: list[Tokens]) -> float | None:
    told = [(t.cached, t.server_prompt) for t in counts if t.cached is not None and t.server_prompt]
    return 100 * sum(cached for cached, _ in told) / sum(prompt for _, prompt in told) if told else None


def _saved_pct(kept: float | None, whole: float | None) -> float | None:
    return 100 * (1 - kept / whole) if kept is not None and whole else None
