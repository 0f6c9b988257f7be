"""The attention and velocity modules as torch's, which learn jointly."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from service.learning.attention import Attention
from service.learning.parameters import Layout, Weights
from service.learning.sample import Sample
from service.learning.velocity import ReachVelocityScorer, VelocityScorer
from shared.features import FEATURES
from shared.reach import LEVEL_FEATURES
from shared.wire import Features


class Modules(nn.Module):
    """The attention and velocity modules of one feature preset, which learn jointly."""

    def __init__(self, preset: Features, levels: int, seed: int) -> None:
        super().__init__()
        self.preset: Features = preset
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.attention = Attention(FEATURES[preset])
            self.velocity = VelocityScorer(levels) if preset == "paper" else ReachVelocityScorer(LEVEL_FEATURES)

    def evaluate(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """Scores ``(n,)`` of the sensors, and values ``(levels,)`` of the velocities for the sensor decided."""
        scores, z = self.attention(torch.from_numpy(sample.features))
        return scores, self.velocity(z[sample.chosen], torch.from_numpy(sample.approach).to(z.dtype))

    def loss(self, sample: Sample, reward: float) -> Tensor:
        """``(s_j - r)^2 + (u_v - r)^2`` for the sensor j and velocity v decided, r = -c."""
        scores, values = self.evaluate(sample)
        loss: Tensor = (scores[sample.chosen] - reward) ** 2 + (values[sample.velocity] - reward) ** 2
        return loss

    def weights(self) -> Weights:
        """A copy to decide by."""
        layout = Layout.of(self.preset, self.named_parameters())
        return Weights(layout, layout.flat([p.detach() for p in self.parameters()]))
