"""The student of decisions: it answers compact prompts with a letter, as its teachers do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from lab.distilling.examples import PromptExample
from lab.distilling.loss import LETTERS, Outputs, Targets, answer_loss, loss_of
from lab.distilling.student import Student

# The tokens whose logits differ by a row's worth.
_WORTH = "09"
_EVALUATION_BATCH = 64


class DecisionStudent(Student):
    """A student that reads compact prompts."""

    def outputs(self, texts: Sequence[str]) -> Outputs:
        """The logits after each user message, and after the letter of each of its rows."""
        letters, worth = (self.tokenizer.convert_tokens_to_ids(list(tokens)) for tokens in (LETTERS, _WORTH))
        middles: list[list[int]] = self.tokenizer(list(texts), add_special_tokens=False).input_ids
        ids = [self.before + middle + self.after for middle in middles]
        states = self.read(ids)
        rows: list[tuple[int, int]] = []
        for number, (own, middle) in enumerate(zip(ids, middles, strict=True)):
            first = states.shape[1] - len(own) + len(self.before)
            rows += [(number, first + place) for place, token in enumerate(middle) if token in letters]
        prompts, places = torch.tensor(rows, device=self.device).T
        after_row, offered = states[prompts, places], torch.tensor(letters, device=self.device)
        worst, best = self.logits(after_row, torch.tensor(worth, device=self.device)).T
        return Outputs(self.logits(states[:, -1], offered), self.logits(after_row, offered), best - worst)

    def loss(self, examples: Sequence[PromptExample]) -> torch.Tensor:
        """The loss of these examples."""
        outputs = self.outputs([example.text for example in examples])
        return loss_of(outputs, Targets.of(examples, outputs.answer.device))


@dataclass(frozen=True, slots=True)
class Agreement:
    """The agreement of a student with the teacher, over held-out decisions.

    Attributes:
        sensor: share of decisions whose likeliest letter is of the teacher's sensor, where that is shown.
        target: mean target probability of the likeliest letter's action.
        loss: mean cross-entropy of the answer's letter.
    """

    decisions: int
    sensor: float
    target: float
    loss: float


@torch.no_grad()
def agreement(student: DecisionStudent, examples: Sequence[PromptExample]) -> Agreement:
    """The agreement over these examples; there is at least one."""
    student.model.eval()
    same, shown, share, loss = 0, 0, 0.0, 0.0
    for start in range(0, len(examples), _EVALUATION_BATCH):
        batch = examples[start : start + _EVALUATION_BATCH]
        answer = student.outputs([example.text for example in batch]).answer.cpu()
        targets = Targets.of(batch)
        loss += float(answer_loss(answer, targets)) * len(batch)
        best = answer.masked_fill(~targets.offered, -torch.inf).argmax(dim=1)
        for example, letter in zip(batch, best.tolist(), strict=True):
            place = example.labels.index(LETTERS[letter])
            share += float(example.target[place])
            if example.reference >= 0:
                shown += 1
                same += example.sensors[place] == example.sensors[example.reference]
    student.model.train()
    return Agreement(len(examples), same / max(shown, 1), share / len(examples), loss / len(examples))
