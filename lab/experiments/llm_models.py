"""Several LLMs, no LLM, and random answers in comparison."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import CHANCE, NAMED_BY_OPTION, Scheme, edge_policy, guided, local, over_edge, value


def _schemes(setup: Setup) -> list[Scheme]:
    embedded = "SmolLM2-135M (embedded)" if setup.llm.embedded else "the LLM of --llm"
    backings = [
        *((f"llm_{path.stem}", path.stem, str(path)) for path in setup.models),
        ("llm", embedded, NAMED_BY_OPTION),
    ]
    of_llms = [over_edge(name, label, backing=backing) for name, label, backing in backings]
    chance = over_edge("llm_chance", "uniform draws in place of an LLM", backing=CHANCE)
    return [*of_llms, chance, guided(), value(), edge_policy(), local("eof"), local("random")]


EXPERIMENT = Experiment(
    name="llm-models",
    title="By the LLM backings",
    summary="each --model GGUF and the embedded LLM, beside uniform draws and no LLM",
    schemes=_schemes,
    measures=(*LOSSES, "failures", "overflows", "rtt_p50", "llm_decided_pct"),
    figures=(
        FigureSpec("llm_models", "bars", LOSSES, "Losses by the LLM that decides, k = 5."),
        FigureSpec("llm_models_latency", "bars", ("rtt_p50",), "Median round trip by the LLM that decides."),
    ),
    references=("llm_chance",),
    notes=(
        "Only models at hand are measured: SmolLM2-135M is the one that ships; give others with --model FILE.gguf. "
        "What a larger model would do is not known from this.",
        "Uniform draws: same attention, same k, same checks, an answer drawn uniformly among those allowed. An LLM "
        "that does not beat it adds nothing.",
    ),
)
