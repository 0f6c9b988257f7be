"""The embedded LLM with its adapter, in a view without learned links, with and without experiences."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import Scheme, adapted_llm

_COUNTS = (0, 8, 30)


def _unlearned(experiences: int) -> Scheme:
    return adapted_llm(
        f"unlearned_{experiences}",
        f"unlearned rows, {experiences} experiences",
        belief="reported",
        features="reach",
        prompt={"experiences": experiences},
    )


def _schemes(setup: Setup) -> list[Scheme]:
    return [*map(_unlearned, _COUNTS), adapted_llm()]


EXPERIMENT = Experiment(
    name="adapter-experiences",
    title="The adapter and its experiences",
    summary="mode llm with the adapter, rows by the formulas, and 0, 8 or 30 experiences in the prompt",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "rtt_p50", "llm_decided_pct"),
    figures=(FigureSpec("adapter_experiences", "bars", ("lost_packets",), "Lost packets of a mission by scenario."),),
    references=("unlearned_0",),
    paired_measures=("lost_packets",),
    worlds=("paper", "faulty", "shadowed"),
    notes=(
        "Unlearned rows have each UAV's own last reports and the formulas' links, so that they mislead where a radio "
        "is dead or a link shadowed. Neither planner, verifier nor critic takes part.",
        "The last scheme is for comparison: its rows have what the fleet has learned of its links, as by default.",
    ),
)
