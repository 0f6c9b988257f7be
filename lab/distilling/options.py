"""The options of ``python -m lab distill`` and ``python -m lab distill-orders``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import arg


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """The options of both trainings."""

    out: Annotated[Path, arg(metavar="FOLDER")]
    """Folder of the examples, the checkpoint and the adapter."""
    begin: Annotated[Path | None, arg(metavar="FOLDER|FILE")] = None
    """The adapter to go on from, with new examples: an earlier run's peft/ folder, or an adapter.gguf, such as the one
    that ships. Its rank stays. By default the adapter begins at zero."""
    steps: int = 3000
    """Steps of Adam."""
    batch: int = 16
    """Examples a step."""
    rank: int = 8
    """Rank of the adapter's matrices: 8 makes a file of 5 MB."""
    learning_rate: float = 1e-3
    """Adam's step size after 30 steps; it falls to a tenth along a cosine."""
    seed: int = 0
    """Of the initial weights and of the examples and their order."""
    threads: int = 0
    """Threads of the training on a CPU; 0: all cores."""
    device: str = "auto"
    """A device of torch; auto: a GPU where there is one."""


@dataclass(frozen=True, kw_only=True)
class Distill(TrainingOptions):
    """Train a LoRA adapter: the embedded LLM learns the compact prompt and the teachers' decisions.

    Record first, a file for each scenario:  python -m lab explore --scenario shadowed --out runs/shadowed.jsonl.gz

    Then:  python -m lab distill runs/*.jsonl.gz --out runs/adapter

    The rows of a prompt and their letters are shuffled. The target of a decision is the teacher's sensor, with 0.2 of
    the probability, and every candidate by its expected loss, with the rest. Every eleventh mission of a file is held
    out. Training goes on where it was interrupted: the folder has its examples and its last checkpoint. A step of
    16 decisions takes some 4 s of one core that multiplies bfloat16 fast, and 12 s or more of another.

    The folder gets adapter.gguf for llama.cpp (AICVDS_LLM_ADAPTER), peft/ for vLLM, and card.json with the result.

    With --begin and no recording nothing is trained, and the folder gets the earlier adapter in both formats.
    """

    rollouts: Annotated[tyro.conf.Positional[tuple[Path, ...]], arg(metavar="FILE")]
    """Files that `python -m lab explore` wrote, with a teacher."""
    workers: int = 1
    """Processes that make the examples."""
    ray: Annotated[str | None, arg(metavar="local|HOST:PORT", help_behavior_hint="")] = None
    """Make them as tasks of Ray: of one that starts here with --workers processes, or of a cluster with this machine in
    it. Needs the extra `ray`."""


@dataclass(frozen=True, kw_only=True)
class DistillOrders(TrainingOptions):
    """Train the adapter that reads operators' notes: the embedded LLM learns to write them as orders.

    python -m lab distill-orders --out runs/orders

    The notes are made up, of the phrasings in lab/distilling/phrasings.toml and the operators' styles in
    operators.toml; every seventh phrasing and two operators are held out. Training goes on where it was interrupted.
    A step of 8 notes takes 4 to 5 s of one core without AVX-512.

    The folder gets adapter.gguf for llama.cpp (AICVDS_LLM_ORDERS), peft/, and card.json with the result.
    """

    steps: int = 1000
    """Steps of Adam."""
    batch: int = 16
    """Notes a step."""
    notes: Annotated[tuple[Path, ...], arg(metavar="FILE")] = ()
    """Notes that were written one by one, as JSON lists of {"note": ..., "guidance": ...}. Half the notes of a training
    are then of these files, each time with other letters."""
