"""The words of a mission's report: policy names, notices and the outcome in one sentence."""

from simulator.records.summary import Summary

# The share of LLM decisions from which a mission of mode `llm` counts as a result of the LLM.
LLM_SHARE = 0.9
NAMES = {
    "aic_vds": "AIC-VDS",
    "eof": "EOF",
    "wqcs": "WQCS",
    "max_gain": "maximum channel gain",
    "nearest": "nearest neighbour",
}
ADVISERS = {"llm": "LLM", "planner": "planner", "value": "learned values", "policy": "look-ahead"}


def world_text(summary: Summary) -> str:
    """The world that was flown: ``paper, seed 0``; real sensors have no seed."""
    return summary.scenario + (", real sensors" if summary.seed is None else f", seed {summary.seed}")


def deciders_text(summary: Summary) -> str:
    """The sources of the decisions, and the adviser that weighed most: ``87 guided (planner 97%), 3 policy``."""
    leading = next(iter(summary.trust.items()), None)
    weight = "" if leading is None else f" ({ADVISERS.get(leading[0], leading[0])} {percent(leading[1])})"
    counts = summary.by_source.present().items()
    return ", ".join(f"{count} {name}{weight if name == 'guided' else ''}" for name, count in counts) or "none"


def policy_labels(summary: Summary) -> dict[str, str]:
    """The policies' display names; the edge's includes the sources of its decisions."""
    flown = {"aic_vds": f"AIC-VDS: {deciders_text(summary)}"} if summary.decisions else {}
    return {**{n: n if ":" in n else n.replace("_", " ") for n in summary.lost_packets}, **NAMES, **flown}


def llm_notice(summary: Summary) -> str | None:
    """The LLM's part in a mission whose mode uses it; ``None`` where the LLM has no part."""
    if summary.policy != "edge" or not summary.decisions:
        return None
    if summary.mode == "guided":
        return _guided_notice(summary)
    by = summary.by_source
    if summary.mode != "llm" or by.llm >= LLM_SHARE * summary.decisions:
        return None
    return (
        f"The LLM took {by.llm} of {summary.decisions} decisions; {_others(summary)}, "
        f"so this is not a result of the LLM.{_without_llm(summary)}"
    )


def _guided_notice(summary: Summary) -> str:
    by = summary.by_source
    if not by.guided:
        return f"The LLM took part in none of the {summary.decisions} decisions: {_others(summary)}."
    weights = ", ".join(f"{ADVISERS.get(name, name)} {percent(weight)}" for name, weight in summary.trust.items())
    weighed = f" Mean weight of each adviser: {weights}." if weights else ""
    rest = "" if by.guided == summary.decisions else f" The others: {_others(summary)}."
    part = f"The LLM was one of several advisers in {by.guided} of {summary.decisions} decisions."
    return f"{part}{weighed}{rest}{_without_llm(summary)}"


def _without_llm(summary: Summary) -> str:
    """What the mission loses without its LLM."""
    if summary.without_llm is None:
        return ""
    return f" Without the LLM (mode policy) the same edge lost {_packets(summary.without_llm)} in this world."


def _others(summary: Summary) -> str:
    """The decisions without the LLM, by decider, and their reasons."""
    by = summary.by_source
    made = {"the edge's LLM-free policy": by.policy, "its learned values": by.value, "the UAVs themselves": by.onboard}
    owners = [f"{count} by {owner}" for owner, count in made.items() if count]
    reasons = ", ".join(f"{reason} {count}" for reason, count in summary.by_reason.items())
    return f"{' and '.join(owners)} (reasons: {reasons or 'none given'})"


def verdict(summary: Summary) -> str:
    """The outcome in one sentence."""
    if not summary.steps_flown:
        return "Nothing was flown, so there is nothing to compare."
    name, *others = summary.lost_packets
    if summary.real_uavs is not None:
        return f"The UAVs heard that sensors lost {_packets(summary.lost_packets[name])} in this flight."
    labels = {**{n: n if ":" in n else n.replace("_", " ") for n in summary.lost_packets}, **NAMES}
    lost, rivals = summary.lost_packets[name], [summary.lost_packets[other] for other in others]
    outcome = f"In this one example {labels[name]} lost {_packets(lost)}"
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


def bound_text(summary: Summary) -> str | None:
    """What no flight in this world can undercut, and what this mission lost; ``None`` where no bound was wanted."""
    if summary.bound is None:
        return (
            None if summary.bound_missing is None else f"The least possible loss is unknown: {summary.bound_missing}."
        )
    lost, least, best = next(iter(summary.lost_packets.values())), summary.bound.lower_bound, summary.bound.best_flight
    text = f"Nobody can lose fewer than {_packets(least)} in this world; this mission lost {lost:,}."
    if best > least:
        text += f" A search that knows all arrivals found a flight that loses {best:,}; `aicvds bound` searches longer."
    return text


def orders_text(summary: Summary) -> str | None:
    """Whether the operator's orders were in force; ``None`` where the operator gave neither orders nor a note."""
    if summary.operator is None:
        return None
    if not summary.operator.in_force:
        return "No order of the operator was in force: none was confirmed."
    orders = " ".join(dict.fromkeys(order.in_words for order in summary.operator.in_force))
    return f"Orders of the operator were in force, which may cost packets: {orders}"


def late_text(summary: Summary) -> str | None:
    """The late decisions of real UAVs; ``None`` for a simulated mission, whose steps wait for the decisions."""
    if summary.real_uavs is None:
        return None
    return (
        f"Late: {summary.real_uavs.late} decisions after their waypoint's step, {summary.late} after their deadline + "
        "50 ms."
    )


def _packets(count: int) -> str:
    return f"{count:,} packet{'' if count == 1 else 's'}"


def percent(share: float) -> str:
    """A share as a whole percentage; one that is neither 0 nor 1 is not rounded to them."""
    if 0 < share < 0.005:
        return "<1%"
    if 0.995 <= share < 1:
        return ">99%"
    return f"{100 * share:.0f}%"


def number(value: float | None, digits: int = 1) -> str:
    """A number for a table with thousands separators; a dash for ``None``."""
    return "–" if value is None else f"{value:,.{digits}f}"
