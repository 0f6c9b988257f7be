"""Round-trip latency a waypoint, and where it goes, by k, with the LLM and without."""

from __future__ import annotations

from simulator.experiments.plan import Drawing, Experiment, Setup
from simulator.experiments.schemes import OFF, Scheme, over_edge

_KEPT = (1, 3, 5, 10)
_KEPT_QUICK = (1, 5, 10)
_TRIPS = ("rtt_p50", "rtt_p90", "rtt_p99")
_SHARES = ("share_llm", "share_augment", "share_attend", "share_prompt", "share_check", "share_network")


def _schemes(setup: Setup) -> list[Scheme]:
    kept = _KEPT_QUICK if setup.quick else _KEPT
    asking = [over_edge(f"llm_k{k}", f"mode llm, k = {k}", top_k=k, deadline_ms=None) for k in kept]
    value = [
        over_edge(f"value_k{k}", f"mode value, k = {k}", mode="value", top_k=k, backing=OFF, deadline_ms=None)
        for k in kept
    ]
    return [*asking, *value]


EXPERIMENT = Experiment(
    name="latency",
    title="Round-trip latency",
    summary="round trip a waypoint (p50, p90, p99) and its stages, by k, with the LLM and without",
    schemes=_schemes,
    measures=(*_TRIPS, *_SHARES, "llm_decided_pct", "lost_packets", "events"),
    drawings=(
        Drawing("latency", "curves", ("rtt_ms_per_step",), "Round-trip latency at each waypoint."),
        Drawing("latency_percentiles", "bars", _TRIPS, "Percentiles of a mission's round trips."),
        Drawing("latency_stages", "bars", _SHARES, "Where the round trip goes, in percent of it."),
    ),
    pairs=tuple((f"llm_k{k}", f"value_k{k}") for k in _KEPT),
    paired_measures=("rtt_p50",),
    notes=(
        "With the edge's default deadline of 3 s: a decision later than that is the policy's. Simulator, edge and LLM "
        "share one machine, so the network's share is HTTP over loopback. The numbers are this machine's, and they "
        "differ from run to run.",
    ),
)
