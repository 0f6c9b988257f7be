"""The student of notes: it writes a note's orders, letter for number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from lab.distilling.note_examples import NoteExample
from lab.distilling.student import Student

_EVALUATION_BATCH = 64


class NoteStudent(Student):
    """A student that reads notes whose numbers are letters."""

    def loss(self, examples: Sequence[NoteExample]) -> Tensor:
        """The mean cross-entropy of the orders' tokens."""
        logits, tokens, _ = self._answers(examples)
        return cross_entropy(logits, tokens)

    @torch.no_grad()
    def right(self, examples: Sequence[NoteExample]) -> list[bool]:
        """Whether the likeliest tokens are each note's orders, to the last token."""
        logits, tokens, lengths = self._answers(examples)
        same = iter((logits.argmax(dim=1) == tokens).tolist())
        return [all(list(islice(same, length))) for length in lengths]

    def _answers(self, examples: Sequence[NoteExample]) -> tuple[Tensor, Tensor, list[int]]:
        """The logits before each token of the answers, these tokens, and each answer's length."""
        notes = self.tokenizer([example.text for example in examples], add_special_tokens=False).input_ids
        orders = self.tokenizer([example.orders for example in examples], add_special_tokens=False).input_ids
        answers = [[*order, self.tokenizer.eos_token_id] for order in orders]
        ids = [[*note, *self.after, *answer] for note, answer in zip(notes, answers, strict=True)]
        states = self.read(ids, prefix=self.before)
        before = torch.cat([own[-len(answer) - 1 : -1] for own, answer in zip(states, answers, strict=True)])
        tokens = torch.tensor([token for answer in answers for token in answer], device=self.device)
        return self.logits(before), tokens, list(map(len, answers))


@dataclass(frozen=True, slots=True)
class Understanding:
    """How a student reads held-out notes: the share whose orders are right to the last token."""

    notes: int
    right: float


def understanding(student: NoteStudent, examples: Sequence[NoteExample]) -> Understanding:
    """The share of these notes that is read right; there is at least one."""
    student.model.eval()
    right = [
        one
        for start in range(0, len(examples), _EVALUATION_BATCH)
        for one in student.right(examples[start : start + _EVALUATION_BATCH])
    ]
    student.model.train()
    return Understanding(len(right), sum(right) / len(right))
