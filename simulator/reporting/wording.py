"""The words of a mission's report: policy names, notices and the outcome in one sentence."""

from __future__ import annotations

from simulator.records.summary import Summary, sources_text

# The share of LLM decisions from which a mission counts as a result of the LLM.
LLM_SHARE = 0.9
NAMES = {
    "aic_vds": "AIC-VDS",
    "eof": "EOF",
    "wqcs": "WQCS",
    "round_robin": "round robin",
    "random": "random",
    "max_gain": "maximum channel gain",
    "nearest": "nearest neighbour",
}


def policy_labels(summary: Summary) -> dict[str, str]:
    """The policies' display names; the edge's includes the sources of its decisions."""
    flown = {"aic_vds": f"AIC-VDS ({sources_text(summary.by_source)})"} if summary.decisions else {}
    return {**dict(zip(summary.lost_packets, summary.lost_packets, strict=True)), **NAMES, **flown}


def llm_notice(summary: Summary) -> str | None:
    """A warning if the mission's mode uses the LLM and too few decisions are the LLM's, else ``None``."""
    by = summary.by_source
    uses_llm = summary.mode in ("llm", "guided")
    if not uses_llm or summary.policy != "edge" or by.llm + by.guided >= LLM_SHARE * summary.decisions:
        return None
    owners = [
        f"{owner} {count}"
        for owner, count in (
            ("the edge's LLM-free policy's", by.policy),
            ("its learned values'", by.value),
            ("the UAVs' own", by.onboard),
        )
        if count
    ]
    reasons = ", ".join(f"{reason} {count}" for reason, count in summary.by_reason.items())
    return (
        f"The LLM took {by.llm + by.guided} of {summary.decisions} decisions; the rest are {' and '.join(owners)} "
        f"(reasons: {reasons or 'none given'}), so this is not a result of the LLM."
    )


def verdict(summary: Summary) -> str:
    """The outcome in one sentence."""
    if not summary.steps_flown:
        return "Nothing was flown, so there is nothing to compare."
    name, *others = summary.lost_packets
    labels = policy_labels(summary)
    lost, rivals = summary.lost_packets[name], [summary.lost_packets[other] for other in others]
    outcome = f"In this one example {labels[name]} lost {lost:,} packets"
    if not rivals:
        return f"{outcome}."
    against = " and ".join(f"{labels[other]}'s {summary.lost_packets[other]:,}" for other in others)
    if {lost} == set(rivals):
        rank = "the same"
    elif lost < min(rivals):
        rank = "the fewest"
    elif lost > max(rivals):
        rank = "the most"
    else:
        rank = "as many as the best of them" if lost == min(rivals) else "neither the fewest nor the most"
    return f"{outcome} against {against}: {rank}."


def number(value: float | None, digits: int = 1) -> str:
    """A number for a table with thousands separators; a dash for ``None``."""
    return "–" if value is None else f"{value:,.{digits}f}"
