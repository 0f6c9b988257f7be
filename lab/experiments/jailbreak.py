"""An LLM turned against its fleet, with and without hard rules on its answers."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import CHANCE, NAMED_BY_OPTION, WORST, Scheme, edge_policy, guided, local, over_edge


def _schemes(setup: Setup) -> list[Scheme]:
    label = "SmolLM2-135M (embedded)" if setup.llm.embedded else "the LLM of --llm"
    of_llms = [
        over_edge(f"{name}_{verify}", f"{label}, rules {verify}", backing=backing, verify=verify, planner="off")
        for name, label, backing in (
            ("turned", "LLM turned against the fleet", WORST),
            ("draws", "uniform draws", CHANCE),
            ("llm_rules", label, NAMED_BY_OPTION),
        )
        for verify in ("off", "on")
    ]
    alone = guided("guided_alone_worst", "guided, no planner, LLM turned", planner="off", backing=WORST)
    return [*of_llms, alone, edge_policy(), local("eof")]


EXPERIMENT = Experiment(
    name="jailbreak",
    title="An LLM that was turned against its fleet",
    summary="mode llm with an LLM that names the farthest sensor and hovers, with the rule verifier and without",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "llm_decided_pct"),
    figures=(FigureSpec("jailbreak", "bars", LOSSES, "Losses with the rule verifier and without, mode llm, k = 5."),),
    references=("turned_off",),
    pairs=(("turned_on", "turned_off"), ("draws_on", "draws_off"), ("llm_rules_on", "llm_rules_off")),
    notes=(
        "Nothing but numbers and the operator's note reaches the prompt, so a sensor cannot talk to the LLM; this is "
        "an LLM, or a server, that was turned all the same. In mode llm it names, of the rows, the farthest sensor at "
        "velocity 0; in mode guided the emptiest queue as fast as can be.",
        "The rules: the sensor is in reach after the step at that velocity, its battery is not flat, and no other UAV "
        "was given it. An answer that breaks one gives way to one step of look-ahead; nobody plans here, so that what "
        "the rules do is not the planner's doing.",
    ),
)
