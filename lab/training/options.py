"""The options of ``python -m lab pretrain``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import arg

from lab.training.reward import Speed, Target
from shared.wire.schemas import Belief, Features


@dataclass(frozen=True)
class Pretrain:
    """Train the attention and velocity modules on recorded rollouts and write the checkpoint that missions start from.

    Record first:  python -m lab explore --workers 2 --out runs/rollouts.jsonl.gz

    Then:  python -m lab pretrain runs/rollouts.jsonl.gz --features reach --out runs/reach.npz

    Several files train on several scenarios, every decision with the same weight. Their UAVs need the same velocities.

    Target `return`: value regression as online, but of the discounted cost over several steps, since the loss of a bad
    decision comes after it; and s_j and u_v learn to rank the teacher's sensor and a velocity for it first
    (cross-entropy of their softmax).
    Target `immediate` is the paper's: regression of this one step's cost, without a teacher.

    Every eleventh mission of a file is held out. The command prints the loss on these missions. For each file, and the
    trained weights, random weights and the package's own checkpoint, it also prints how often each teacher's sensor is
    among the k best, and how near the velocity is to the teacher's. The same command writes the same weights.
    """

    rollouts: Annotated[tyro.conf.Positional[tuple[Path, ...]], arg(metavar="FILE FILE...")]
    """Files that `python -m lab explore` wrote, one or more."""
    out: Annotated[Path, arg(metavar="FILE")]
    """Checkpoint to write. The package's own are service/checkpoints/paper.npz and reach.npz, one a feature preset."""
    features: Features = "paper"
    """The modules' inputs: the paper's five numbers a sensor, or also the reach along the trajectory."""
    belief: Belief | None = None
    """The source of the inputs: `fleet`, all reports to the edge, or `reported`, the UAV's own latest beacons.
    Default: reported for paper, fleet for reach, as missions have it."""
    target: Target = "return"
    """The target: the return over several steps and the teachers' ranking, or the paper's immediate cost."""
    epochs: int = 8
    """Passes over the rollouts."""
    horizon: int = 8
    """Steps of cost that count for a decision; target immediate has 1."""
    discount: float = 0.9
    """Weight of each later step against the one before it."""
    ranking: float = 1.0
    """Weight of the ranking against the value regression; 0 is none. Target immediate has none."""
    speed: Speed = "look_ahead"
    """The velocity that is ranked first: the best of one step of look-ahead for the teacher's sensor, or the teacher's
    own. A planner hovers or races as its whole plan requires; modules that learn this from one state hover."""
    temperature: float = 0.05
    """Of the softmax that ranks: about the difference between good and bad values, so that they keep r's scale."""
    learning_rate: float = 2e-3
    """Adam's step size at the start; it falls to a tenth."""
    batch: int = 64
    """Decisions a step of Adam."""
    seed: int = 0
    """Of the initial weights and the order of the decisions."""
