"""The words of a mission's report: policy names, notices and the outcome in one sentence."""

from __future__ import annotations

from simulator.records.summary import Summary, told_sources

# Of the decisions, that the LLM must have taken for the mission to count as the LLM's.
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
    """The policies' names as people write them; the edge's with who really decided."""
    flown = {"aic_vds": f"AIC-VDS ({told_sources(summary.by_source)})"} if summary.decisions else {}
    return {**dict(zip(summary.lost_packets, summary.lost_packets, strict=True)), **NAMES, **flown}


def llm_notice(summary: Summary) -> str | None:
    """A warning when the LLM was to decide and too often did not; ``None`` when there is nothing to warn of."""
    by = summary.by_source
    asks = summary.mode in ("llm", "guided")
    if not asks or summary.policy != "edge" or by.llm + by.guided >= LLM_SHARE * summary.decisions:
        return None
    owners = [
        f"{words} {count}"
        for words, count in (
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
    told = f"In this one example {labels[name]} lost {lost:,} packets"
    if not rivals:
        return f"{told}."
    against = " and ".join(f"{labels[other]}'s {summary.lost_packets[other]:,}" for other in others)
    if {lost} == set(rivals):
        rank = "the same"
    elif lost < min(rivals):
        rank = "the fewest"
    elif lost > max(rivals):
        rank = "the most"
    else:
        rank = "as many as the best of them" if lost == min(rivals) else "neither the fewest nor the most"
    return f"{told} against {against}: {rank}."


def number(value: float | None, digits: int = 1) -> str:
    """A figure for a table, thousands apart by a comma; a dash when there is none."""
    return "–" if value is None else f"{value:,.{digits}f}"
