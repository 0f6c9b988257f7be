"""One LLM beside another, beside none, and beside one that answers at random."""

from __future__ import annotations

from simulator.experiments.measures import LOSSES
from simulator.experiments.plan import Drawing, Experiment, Setup
from simulator.experiments.schemes import CHANCE, Scheme, edge_policy, guided, llm, local, over_edge, value


def _schemes(setup: Setup) -> list[Scheme]:
    given = [over_edge(f"llm_{path.stem}", path.stem, backing=str(path)) for path in setup.models]
    asked = llm().model_copy(update={"label": "SmolLM2-135M (embedded)" if setup.llm.embedded else "the LLM of --llm"})
    chance = over_edge("llm_chance", "uniform draws in place of an LLM", backing=CHANCE)
    return [*given, asked, chance, guided(), value(), edge_policy(), local("eof"), local("random")]


EXPERIMENT = Experiment(
    name="llm-models",
    title="By the LLM asked",
    summary="each --model GGUF and the embedded LLM, beside no LLM and uniform draws in its place",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "rtt_p50", "llm_decided_pct"),
    drawings=(
        Drawing("llm_models", "bars", LOSSES, "Losses by the LLM that decides, k = 5."),
        Drawing("llm_models_latency", "bars", ("rtt_p50",), "Median round trip by the LLM that decides."),
    ),
    reference="llm_chance",
    notes=(
        "Only models at hand are measured: SmolLM2-135M is the one that ships; give others with --model FILE.gguf. "
        "What a larger model would do is not known from this.",
        "Uniform draws: same attention, same k, same checks, an answer drawn uniformly among those allowed. An LLM "
        "that does not beat it adds nothing.",
    ),
)
