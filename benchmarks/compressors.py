"""The time to shorten a prompt: by a compressor of LLMLingua-2's size, and by this project's attention.

LLMLingua-2 (Pan et al. 2024, arXiv 2403.12968) keeps the tokens that an encoder classifies as worth keeping. The
encoder is XLM-RoBERTa large, or multilingual BERT in the small version, over windows of 512 tokens. Its time does not
depend on the values of its weights, so this module does not download them: it has encoders of the same sizes with
random weights, without the table of embeddings, which takes almost no time. They keep half of the tokens.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from service.learning.initial_weights import initial_weights
from service.learning.modules import top_k
from shared.features.augmented_state import FEATURES
from shared.world.scenario import Scenario

WINDOW = 512
KEPT = 0.5
_LEVELS = 15
_K = 5


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
# For tests: it only shows that the benchmark runs.
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
