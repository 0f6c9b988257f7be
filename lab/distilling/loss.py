"""The training loss of an adapter: the answer's letter, its sensor, and the worth of a row at its letter.

The teacher's probabilities of the letters alone are learned slowly, since one token has to compare five rows. So each
row's last token, its letter, is trained too: the model says there whether the row is the best one and which of its
letters, and the answer has only to find the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from lab.distilling.examples import PromptExample

LETTERS = "ABCDEFGHIJKLMNOPQRST"
# The weight of a row's letter: 0.5, and more for the rows that the teacher prefers.
_LEAST_WEIGHT, _WEIGHT_BY_SHARE = 0.5, 2.0
_NOT_OFFERED = -1e4
_TINY = 1e-9


@dataclass(frozen=True, slots=True)
class Outputs:
    """A student's logits for B prompts that have R rows in all.

    Attributes:
        answer: shape ``(B, 20)``, of the letters as the answer.
        rows: shape ``(R, 20)``, of the letters after each row's letter.
        worth: shape ``(R,)``, that the row is the teacher's.
    """

    answer: Tensor
    rows: Tensor
    worth: Tensor


@dataclass(frozen=True, slots=True)
class Targets:
    """The teacher's probabilities for B prompts that have R rows in all.

    Attributes:
        answer: shape ``(B, 20)``.
        offered: shape ``(B, 20)``, which letters the prompt offers.
        prompt: shape ``(R,)``, the prompt of each row.
        of_row: shape ``(R, 20)``, which letters are the row's.
    """

    answer: Tensor
    offered: Tensor
    prompt: Tensor
    of_row: Tensor

    @classmethod
    def of(cls, examples: Sequence[PromptExample], device: torch.device | None = None) -> Self:
        """From the examples, in their order."""
        answer, offered = torch.zeros(len(examples), len(LETTERS)), torch.zeros(len(examples), len(LETTERS)).bool()
        prompt: list[int] = []
        rows: list[Tensor] = []
        for number, example in enumerate(examples):
            columns = torch.tensor([LETTERS.index(letter) for letter in example.labels])
            answer[number, columns] = torch.tensor(example.target, dtype=torch.float32)
            offered[number, columns] = True
            sensors = torch.tensor(example.sensors)
            for sensor in dict.fromkeys(example.sensors):
                row = torch.zeros(len(LETTERS)).bool()
                row[columns[sensors == sensor]] = True
                rows.append(row)
                prompt.append(number)
        parts = (answer, offered, torch.tensor(prompt), torch.stack(rows))
        return cls(*(part.to(device) for part in parts))

    @property
    def worth(self) -> Tensor:
        """The probability of each row's letters together, ``(R,)``."""
        return (self.answer[self.prompt] * self.of_row).sum(dim=1)


def answer_loss(answer: Tensor, targets: Targets) -> Tensor:
    """``-sum_a t(a) ln p(a)`` over the offered letters, the mean of the prompts."""
    return -(targets.answer * _log_softmax(answer, targets.offered)).sum(dim=1).mean()


def loss_of(outputs: Outputs, targets: Targets) -> Tensor:
    """The sum of four cross-entropies: the answer's letter, its sensor, each row's letter, and each row's worth."""
    probabilities = _log_softmax(outputs.answer, targets.offered).exp()
    by_row = (probabilities[targets.prompt] * targets.of_row).sum(dim=1)
    worth = targets.worth
    sensor = -(worth * torch.log(by_row + _TINY)).sum() / len(targets.answer)
    within = targets.answer[targets.prompt] * targets.of_row / (worth[:, None] + _TINY)
    own = -(within * _log_softmax(outputs.rows, targets.of_row)).sum(dim=1)
    weighted = ((_LEAST_WEIGHT + _WEIGHT_BY_SHARE * worth) * own).mean()
    value = binary_cross_entropy_with_logits(outputs.worth, worth.clamp(max=1.0))
    return answer_loss(outputs.answer, targets) + sensor + weighted + value


def _log_softmax(logits: Tensor, offered: Tensor) -> Tensor:
    return torch.log_softmax(logits.masked_fill(~offered, _NOT_OFFERED), dim=1)
