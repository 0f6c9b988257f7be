"""``summary.json``: the result of one mission."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime

from pydantic import Field

from shared.wire.names import Names
from shared.wire.schemas import Tokens, Uplink
from simulator.records.decision import Decision, Record, jain_index, mean, percentile, queried_llm, visits_per_sensor
from simulator.records.operator import OperatorRecord
from simulator.records.real_uavs import RealUavs
from simulator.world.observation import StepTally

LATE_SLACK_MS = 50.0


class BySource(Record):
    """Numbers of decisions by source; ``value`` are the edge's learned modules, ``policy`` is its LLM-free policy."""

    llm: int = 0
    guided: int = 0
    value: int = 0
    policy: int = 0
    onboard: int = 0

    def present(self) -> dict[str, int]:
        """The sources with any decision, the most frequent first."""
        return dict(sorted(((k, n) for k, n in self.model_dump().items() if n), key=lambda item: -item[1]))


def sources_text(by_source: BySource) -> str:
    """The counts in words: ``87 llm, 3 policy``."""
    return ", ".join(f"{count} {name}" for name, count in by_source.present().items()) or "none"


class TokenSummary(Record):
    """Means over the edge's decisions, ``null`` without any or without token counts.

    ``cached_pct`` is the share of the prompt tokens, by the LLM server's own count, that came from its prefix cache.
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
    """Percentiles of the round-trip time over the edge's decisions, milliseconds."""

    p50: float | None = None
    p99: float | None = None


class LossBound(Record):
    """The least that any fleet could have lost in the flown world, found with all arrivals known beforehand.

    No flight loses fewer packets than ``lower_bound``. The best flight found loses ``best_flight``; where the two are
    equal, it is proven to be the best. ``seconds`` is the time of the search.
    """

    lower_bound: int
    best_flight: int
    seconds: float


class FlightFacts(Record):
    """The facts of a mission beyond its decisions.

    ``seed`` is ``null`` where the sensors are real. ``steps`` is the planned and ``steps_flown`` the actual number of
    steps. ``policy`` is ``edge`` or a local policy's name. ``deadline_ms`` is the last deadline that the edge reported,
    or the requested one. ``uplink`` is ``null`` without an edge.
    """

    scenario: str
    seed: int | None
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


class Summary(FlightFacts):
    """``summary.json``.

    ``lost_packets`` and ``loss_events`` are by policy: ``aic_vds`` (or the local policy flown), ``eof`` and ``wqcs``,
    all over ``steps_flown`` steps of one world. ``late`` counts decisions with a round trip beyond their deadline + 50
    ms. ``jain`` is Jain's index of the sensors' successful visits, ``null`` without any. ``failures`` are failed
    transmissions. ``llm_asked`` counts decisions for which the LLM was queried, with a usable answer or not.
    ``uplink_bytes_mean`` is the mean size of a request, ``attention_bytes_mean`` the mean size of the attention weights
    that a UAV fetched for its decision. ``trust`` is the mean weight of each adviser over the decisions of source
    ``guided``. ``without_llm`` is the packets that the same edge lost in the same world in mode ``policy``, ``null``
    where that was not flown. ``bound`` is ``null`` where ``bound_missing`` says why. ``operator`` is ``null`` without
    a note and orders. ``real_uavs`` is left out of a simulated mission; with it, losses are those that beacons
    reported, and ``uavs`` are those of one command. ``names`` are the user's, of a world that has any.
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
    trust: dict[str, float] = {}
    without_llm: int | None = None
    bound: LossBound | None = None
    bound_missing: str | None = None
    operator: OperatorRecord | None = None
    real_uavs: RealUavs | None = Field(None, exclude_if=lambda value: value is None)
    names: Names | None = Field(None, exclude_if=lambda value: value is None)


def summarise(flown: FlightFacts, decisions: Sequence[Decision], tallies: Mapping[str, Sequence[StepTally]]) -> Summary:
    """The summary of one mission.

    Args:
        flown: the mission's facts.
        decisions: all decisions of its ``steps_flown`` steps.
        tallies: by policy, one tally a step flown.
    """
    from_edge = [d for d in decisions if d.rtt_ms is not None]
    return Summary(
        **flown.model_dump(),
        decisions=len(decisions),
        by_source=BySource.model_validate(Counter(d.source for d in decisions)),
        by_reason=dict(sorted(Counter(d.reason for d in decisions if d.reason is not None).items())),
        lost_packets={name: int(sum(t.lost_packets for t in tally)) for name, tally in tallies.items()},
        loss_events={name: int(sum(t.events for t in tally)) for name, tally in tallies.items()},
        failures=sum(d.failed for d in decisions),
        late=sum(is_late(d) for d in from_edge),
        tokens=_tokens([d.tokens for d in from_edge if d.tokens is not None]),
        rtt_ms=round_trips(decisions),
        uplink_bytes_mean=mean([d.request_bytes for d in from_edge]),
        attention_bytes_mean=mean([d.attention_bytes for d in from_edge]),
        jain=jain_index(visits_per_sensor(decisions, flown.sensors)),
        llm_asked=sum(queried_llm(d) for d in decisions),
        trust=_mean_trust([d.trust for d in decisions if d.source == "guided" and d.trust]),
    )


def round_trips(decisions: Iterable[Decision]) -> RoundTrips:
    """The percentiles over the edge's decisions."""
    trips = [d.rtt_ms for d in decisions if d.rtt_ms is not None]
    return RoundTrips(p50=percentile(trips, 50), p99=percentile(trips, 99))


def _mean_trust(weights: list[dict[str, float]]) -> dict[str, float]:
    """The mean weight of each adviser, the largest first."""
    names = dict.fromkeys(name for one in weights for name in one)
    means = {name: sum(one.get(name, 0.0) for one in weights) / len(weights) for name in names}
    return dict(sorted(means.items(), key=lambda item: -item[1]))


def is_late(decision: Decision) -> bool:
    """Whether its round trip took longer than its deadline + 50 ms."""
    if decision.rtt_ms is None or decision.deadline_ms is None:
        return False
    return decision.rtt_ms > decision.deadline_ms + LATE_SLACK_MS


def _tokens(counts: list[Tokens]) -> TokenSummary:
    kinds = ("prompt", "uncompressed", "state", "state_uncompressed")
    prompt, uncompressed, state, whole = (mean([getattr(t, kind) for t in counts]) for kind in kinds)
    return TokenSummary(
        **dict(zip((f"{kind}_mean" for kind in kinds), (prompt, uncompressed, state, whole), strict=True)),
        saved_pct=_saved_pct(prompt, uncompressed),
        cached_mean=mean([t.cached for t in counts if t.cached is not None]),
        cached_pct=_cached_pct(counts),
        state_saved_pct=_saved_pct(state, whole),
    )


def _cached_pct(counts: list[Tokens]) -> float | None:
    counted = [(t.cached, t.server_prompt) for t in counts if t.cached is not None and t.server_prompt]
    return 100 * sum(cached for cached, _ in counted) / sum(prompt for _, prompt in counted) if counted else None


def _saved_pct(pruned: float | None, whole: float | None) -> float | None:
    return 100 * (1 - pruned / whole) if pruned is not None and whole else None
