"""Round-trip latency a waypoint and its stages, by k, with and without the LLM."""

from __future__ import annotations

from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import OFF, Scheme, over_edge

_TOP_KS = (1, 3, 5, 10)
_TOP_KS_QUICK = (1, 5, 10)
_TRIPS = ("rtt_p50", "rtt_p90", "rtt_p99")
_SHARES = ("share_llm", "share_augment", "share_attend", "share_prompt", "share_check", "share_network")


def _schemes(setup: Setup) -> list[Scheme]:
    top_ks = _TOP_KS_QUICK if setup.quick else _TOP_KS
    llm = [over_edge(f"llm_k{k}", f"mode llm, k = {k}", top_k=k, deadline_ms=None) for k in top_ks]
    value = [
        over_edge(f"value_k{k}", f"mode value, k = {k}", mode="value", top_k=k, backing=OFF, deadline_ms=None)
        for k in top_ks
    ]
    return [*llm, *value]


EXPERIMENT = Experiment(
    name="latency",
    title="Round-trip latency",
    summary="round trip a waypoint (p50, p90, p99) and its stages, by k, with the LLM and without",
    schemes=_schemes,
    measures=(*_TRIPS, *_SHARES, "llm_decided_pct", "lost_packets", "events"),
    figures=(
        FigureSpec("latency", "curves", ("rtt_ms_per_step",), "Round-trip latency at each waypoint."),
        FigureSpec("latency_percentiles", "bars", _TRIPS, "Percentiles of a mission's round trips."),
        FigureSpec("latency_stages", "bars", _SHARES, "Where the round trip goes, in percent of it."),
    ),
    pairs=tuple((f"llm_k{k}", f"value_k{k}") for k in _TOP_KS),
    paired_measures=("rtt_p50",),
    notes=(
        "With the edge's default deadline of 3 s: a decision later than that is the policy's. Simulator, edge and LLM "
        "share one machine, so the network's share is HTTP over loopback. The numbers are this machine's, and they "
        "differ from run to run.",
    ),
)
