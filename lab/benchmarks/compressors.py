"""The time that a shorter prompt saves: by a compressor of LLMLingua-2's size, and by this project's attention.

    python -m benchmarks.tokens               # counts the tokens
    python -m lab.benchmarks.compressors

LLMLingua-2 (Pan et al. 2024, arXiv 2403.12968) keeps the tokens that an encoder classifies as worth keeping. The
encoder is XLM-RoBERTa large, or multilingual BERT in the small version, over windows of 512 tokens. Its time does not
depend on the values of its weights, so none are downloaded: the encoders have the same sizes and random weights,
without the table of embeddings, which takes almost no time. They keep half of the tokens. In each repetition every
encoder takes one window, and the embedded LLM reads about as many tokens. The study prints the ratio of their times
with its 95% bootstrap interval over the pairs, and the prefill speed below which compression pays, and writes the same
as JSON.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from torch import nn

from lab.benchmarks.local_llm import LocalLLM
from lab.experiments.intervals import ratio_of_medians
from service.learning.initial_weights import initial_weights
from service.learning.modules import top_k
from service.llm.request_bodies import chat_body
from service.prompting.paper_prompt import Template
from shared.features.augmented_state import FEATURES
from shared.world.scenario import Scenario, scenario_named

WINDOW = 512
KEPT = 0.5
_LEVELS = 15
_K = 5
_CONTEXT = 8192
# The prefill speeds, tokens a second, at which compression is compared with reading the whole prompt.
SPEEDS = (50, 200, 1_000, 10_000)


@dataclass(frozen=True)
class Compressors:
    """Measure compressors and the embedded LLM side by side."""

    tokens: Path = Path("runs/tokens.json")
    """The file that `python -m benchmarks.tokens` wrote: the tokens of a prompt by its form."""
    threads: int = 1
    """Threads of the embedded LLM and of the compressor."""
    encoders: Literal["real", "tiny"] = "real"
    """Sizes of the compressors; `tiny` only shows that the study runs."""
    repeats: int = 3
    """Repetitions of a compressor's window."""
    out: Path = Path("runs/compressors.json")
    """Where to write the figures."""


@dataclass(frozen=True)
class Size:
    """The sizes of an encoder."""

    label: str
    layers: int
    width: int
    heads: int
    inner: int


SMALL = Size("LLMLingua-2 small (multilingual BERT base)", 12, 768, 12, 3072)
LARGE = Size("LLMLingua-2 (XLM-RoBERTa large)", 24, 1024, 16, 4096)
# For tests: it only shows that the study runs.
TINY = Size("tiny", 1, 64, 2, 128)


class Compressor(nn.Module):
    """Classifies each token's embedding: keep the token or not."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        layer = nn.TransformerEncoderLayer(size.width, size.heads, size.inner, activation="gelu", batch_first=True)
        self._encoder = nn.TransformerEncoder(layer, size.layers, enable_nested_tensor=False)
        self._keep = nn.Linear(size.width, 2)
        self._width = size.width
        self.eval()

    @torch.inference_mode()
    def window_s(self, tokens: int) -> float:
        """Seconds to classify one window of tokens, and to choose half of them."""
        embedded = torch.randn(1, tokens, self._width)
        began = time.perf_counter()
        keep = self._keep(self._encoder(embedded)).softmax(dim=-1)[0, :, 1]
        torch.topk(keep, max(1, int(KEPT * tokens)))
        return time.perf_counter() - began


def attention_s(scenario: Scenario, repeats: int) -> list[float]:
    """Seconds in which the edge's attention module scores all J sensors and takes the best k, for each repetition."""
    weights = initial_weights("pretrained", "paper", _LEVELS, 0)
    features = np.random.default_rng(0).random((scenario.sensors, FEATURES["paper"]), dtype=np.float32)
    took = []
    for _ in range(repeats):
        began = time.perf_counter()
        top_k(weights.attend(features).scores, _K)
        took.append(time.perf_counter() - began)
    return took


def side_by_side(scenario: Scenario, args: Compressors, console: Console) -> tuple[dict[str, list[float]], list[float]]:
    """Seconds of a window by compressor, and the embedded LLM's seconds to read a token."""
    sizes = (SMALL, LARGE) if args.encoders == "real" else (TINY,)
    encoders = {size.label: Compressor(size) for size in sizes}
    window: dict[str, list[float]] = {label: [] for label in encoders}
    read_s: list[float] = []
    # The prompt has about one window of tokens: the static block, and little more.
    static, sensors = Template(scenario).static, list(range(scenario.sensors))
    body = chat_body(None, static, "Current state: none", "grammar", sensors, scenario.max_velocity + 1)
    with LocalLLM(args.threads, _CONTEXT) as llm:
        for _ in track(range(args.repeats), "Compressing", console=console):
            for label, encoder in encoders.items():
                window[label].append(encoder.window_s(WINDOW))
            answered = llm.ask(body, cache_prompt=False, max_tokens=1)
            read_s.append(answered.seconds / max(1, answered.new))
    return window, read_s


def figures(
    tokens: dict[str, Any], window: dict[str, list[float]], read_s: Sequence[float], attention: Sequence[float]
) -> dict[str, Any]:
    """Seconds spent to seconds saved, and the prefill speed below which compression pays.

    An encoder's time is measured on one window; a prompt's time is proportional to it.
    """
    prompt, speed = tokens["paper"]["own"]["mean"], 1 / statistics.median(read_s)
    reckoned_s = {f"{way}, cached": tokens[way]["new"]["mean"] / speed for way in ("guided", "llm", "paper")}
    reckoned_s |= {"paper, whole": prompt / speed}
    compressors = {}
    for label, took in window.items():
        median = statistics.median(took)
        reckoned_s[f"paper, halved by {label}"] = median * prompt / WINDOW + KEPT * prompt / speed
        compressors[label] = {
            "window_s_median": median,
            "spent_to_saved_embedded": ratio_of_medians(took, [s * WINDOW * (1 - KEPT) for s in read_s]),
            "spent_to_saved_at_speed_reckoned": {str(at): median / WINDOW * at / (1 - KEPT) for at in SPEEDS},
            "pays_below_tokens_per_s": WINDOW * (1 - KEPT) / median,
        }
    saved = tokens["llm_no_attention"]["new"]["mean"] - tokens["llm"]["new"]["mean"]
    return {
        "kept": KEPT,
        "embedded_prefill_tokens_per_s": speed,
        "seconds_to_read_reckoned": reckoned_s,
        "compressors": compressors,
        "attention": {
            "ms_median": statistics.median(attention) * 1e3,
            "ms_p99": float(np.quantile(attention, 0.99)) * 1e3,
            "tokens_saved": saved,
            "pays_below_tokens_per_s": saved / statistics.median(attention),
        },
    }


def main(args: Compressors) -> None:
    """Compress, read, print, write."""
    torch.set_num_threads(args.threads)
    console, scenario = Console(highlight=False), scenario_named("paper")
    tokens = json.loads(args.tokens.read_text())["tokens"]
    found = figures(tokens, *side_by_side(scenario, args, console), attention_s(scenario, 200))
    for label, one in found["compressors"].items():
        ratio, low, high = one["spent_to_saved_embedded"]
        console.print(
            f"{label}: {ratio:.3g} [{low:.3g}, {high:.3g}] times the time that halving saves the embedded LLM; "
            f"pays below {one['pays_below_tokens_per_s']:.0f} tokens/s"
        )
    for label, seconds in found["seconds_to_read_reckoned"].items():
        console.print(f"reading {label}: {seconds:.2f} s, computed")
    attention = found["attention"]
    console.print(
        f"attention: {attention['ms_median']:.3f} ms for {attention['tokens_saved']:.1f} tokens; pays below "
        f"{attention['pays_below_tokens_per_s']:.0f} tokens/s (embedded: {found['embedded_prefill_tokens_per_s']:.0f})"
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    console.print(f"Wrote {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Compressors, description=__doc__))
