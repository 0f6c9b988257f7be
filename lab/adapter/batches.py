"""Batches of compact prompts with the teacher's probabilities, for any number of rows, from records on a GPU.

Each time that a decision is drawn, its rows are shuffled, its sensors get new random signs, and its number of
rows is drawn. :func:`targets_of` defines the probabilities.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

LETTERS = "ABCDEFGHIJKLMNOPQRST"
_MOST_EXPERIENCES = 8
# By the number of options a row, the columns of ``vel`` and ``lost`` in the prompt.
_COLUMNS = {4: [0, 1, 2, 3], 3: [0, 4, 3], 2: [0, 3], 1: [5]}
_REFERENCE_SHARE, _AFTER_FAILURE, _HELD_OUT = 0.2, 0.15, 11
# Packets of regret that make an answer e times less likely; and packets that a metre a second is worth.
_TEMPERATURE, _WORTH_OF_VELOCITY = 0.3, 0.2 / 14
_NINE_OF_FASTEST = 9 / 14


@dataclass(frozen=True)
class PromptBatch:
    """B prompts of r rows with V options: tokens ``(B, T)``, targets ``(B, r, V)``, the places of the rows' letters.

    ``regret`` ``(B, r, V)`` is the expected loss of each answer above the best of all sensors and options.
    ``planned`` ``(B, r, V)`` is whether it is the planner's; a prompt may have no such answer. ``sensors`` ``(B, r)``
    and ``velocities`` ``(B, r, V)`` are the answers themselves, as a sensor's place in the records and in m/s.
    """

    tokens: Tensor
    targets: Tensor
    letters_at: Tensor
    regret: Tensor
    planned: Tensor
    sensors: Tensor
    velocities: Tensor


class PromptTokens:
    """The tokens of prompts, as numbers in the model's cut vocabulary; ``tokens.json`` of :mod:`lab.adapter.base`."""

    def __init__(self, file: Path, device: str) -> None:
        known = json.loads(file.read_text())

        def of(texts: str) -> Tensor:
            return torch.tensor([known["char"][text] for text in texts], device=device)

        self.digits, self.letters, self.signs = of("0123456789"), of(LETTERS), of(known["signs"])
        self.uav, self.failed, self.sent = of("U"), of("X"), of("Y")
        self.before, self.after = (torch.tensor(known[name], device=device) for name in ("before", "after"))
        self.sign_of = {sign: place for place, sign in enumerate(known["signs"])}


class RecordTensors:
    """Records as tensors on a device, and batches of them; those of each eleventh world are held out."""

    def __init__(self, arrays: Mapping[str, np.ndarray], tokens: PromptTokens, device: str = "cpu") -> None:
        self._tokens, self._device = tokens, device
        kept = arrays["n"] >= 2
        names = ("fleet", "rows", "vel", "lost", "ref", "refv", "failing", "n")
        self._of = {name: torch.tensor(arrays[name][kept]).to(device) for name in names}
        self._of = {name: one if one.is_floating_point() else one.long() for name, one in self._of.items()}
        self._of["sign"] = torch.tensor(arrays["ids"][kept].astype(np.int64) % len(tokens.signs)).to(device)
        self._of["best"] = self._of["lost"].flatten(1).min(dim=1).values
        blocks = [_entries(text, tokens.sign_of)[-_MOST_EXPERIENCES:] for text in arrays["blocks"][kept].tolist()]
        entries = np.zeros((len(blocks), _MOST_EXPERIENCES, 4), dtype=np.int64)
        for number, block in enumerate(blocks):
            entries[number, : len(block)] = np.reshape(block, (-1, 4))
        self._of["entries"] = torch.tensor(entries).to(device)
        self.experiences = torch.tensor([len(block) for block in blocks], device=device)
        held = torch.tensor(arrays["mission"][kept] % _HELD_OUT == 0, device=device)
        self.training, self.held_out = (~held).nonzero()[:, 0], held.nonzero()[:, 0]
        self._members = lru_cache(maxsize=None)(self._members_of)

    def groups(self, k: int, experiences: int, *, held_out: bool = False) -> dict[int, Tensor]:
        """The decisions with this number of experiences, by the rows of a prompt of at most k rows."""
        return self._members(k, experiences, held_out)

    def _members_of(self, k: int, experiences: int, held_out: bool) -> dict[int, Tensor]:
        own = self.held_out if held_out else self.training
        return self.shown(own[self.experiences[own] == experiences], k)

    def shown(self, which: Tensor, k: int) -> dict[int, Tensor]:
        """These decisions, by the rows of a prompt of at most k rows."""
        shown = self._of["n"][which].clamp(max=k)
        return {int(rows): which[shown == rows] for rows in shown.unique().tolist()}

    def batch(self, which: Tensor, k: int, rows: int, experiences: int, drawn: torch.Generator) -> PromptBatch:
        """The prompts of these decisions, all with ``rows`` rows and ``experiences`` experiences."""
        own, count, tokens = {name: one[which] for name, one in self._of.items()}, len(which), self._tokens
        columns = torch.tensor(_COLUMNS[max(1, min(4, len(LETTERS) // k))], device=self._device)
        order = torch.rand(count, rows, device=self._device, generator=drawn).argsort(1)

        def shuffled(name: str) -> Tensor:
            values = own[name][:, :rows]
            places = order.view(count, rows, *[1] * (values.dim() - 2)).expand(count, rows, *values.shape[2:])
            return values.gather(1, places)

        velocities, lost = shuffled("vel")[..., columns], shuffled("lost")[..., columns]
        signs = torch.rand(count, len(tokens.signs), device=self._device, generator=drawn).argsort(1)
        digits, spans = shuffled("rows"), velocities[..., [0, -1]].float() * _NINE_OF_FASTEST
        first = tokens.letters[torch.arange(rows, device=self._device) * len(columns)].expand(count, rows)
        lines = torch.cat(
            (
                tokens.digits[digits[..., :1]],
                tokens.signs[signs.gather(1, shuffled("sign"))][..., None],
                tokens.digits[digits[..., 1:]],
                tokens.digits[spans.round().long().clamp(0, 9)],
                first[..., None],
            ),
            dim=-1,
        )
        read = self._read(own["entries"][:, :experiences], signs)
        head = torch.cat((tokens.before.expand(count, -1), read, tokens.digits[own["fleet"]]), dim=1)
        text = torch.cat((head, tokens.uav.expand(count, 1), lines.flatten(1), tokens.after.expand(count, -1)), dim=1)
        at = head.shape[1] + lines.shape[2] * torch.arange(1, rows + 1, device=self._device)
        planned = _planned(velocities, order == own["ref"][:, None], own["refv"])
        targets = targets_of(lost, velocities, planned, shuffled("failing"))
        return PromptBatch(text, targets, at, lost - own["best"][:, None, None], planned, order, velocities)

    def _read(self, entries: Tensor, signs: Tensor) -> Tensor:
        """The tokens of experiences ``(B, e, 4)``."""
        tokens, known = self._tokens, signs.gather(1, entries[..., 1])
        ends = torch.where(entries[..., 3] == 1, tokens.failed, tokens.sent)
        parts = tokens.digits[entries[..., 0]], tokens.signs[known], tokens.digits[entries[..., 2]], ends
        return torch.stack(parts, dim=-1).flatten(1)


def _planned(velocities: Tensor, is_sensor: Tensor, velocity: Tensor) -> Tensor:
    """Whether each option is the planner's sensor at the velocity nearest to the planner's."""
    nearest = (velocities - velocity[:, None, None]).abs().argmin(dim=-1, keepdim=True)
    return is_sensor[..., None] & (velocities == velocities.gather(2, nearest))


def targets_of(lost: Tensor, velocities: Tensor, planned: Tensor, failing: Tensor) -> Tensor:
    """Probabilities by regret, and a share for the planner's sensor; within a sensor by regret alone.

    More than half of the options lose nothing in any of the evaluator's futures. The student learns the faster one
    of these: a student that spreads over them has no reason for any velocity, and its likeliest answer is arbitrary.
    """
    worth = lost - _WORTH_OF_VELOCITY * velocities
    times = (velocities[..., :, None] == velocities[..., None, :]).sum(dim=-1)
    by_regret = torch.exp(-(worth - worth.amin((1, 2), keepdim=True)).clamp(max=15.0) / _TEMPERATURE) / times
    by_regret = by_regret / by_regret.sum((1, 2), keepdim=True)
    within = torch.exp(-(worth - worth.amin(2, keepdim=True)).clamp(max=15.0) / _TEMPERATURE) / times
    within = within / within.sum(2, keepdim=True)
    is_sensor = planned.any(2)
    shown = is_sensor.any(1)[:, None, None]
    mixed = (1 - _REFERENCE_SHARE) * by_regret + _REFERENCE_SHARE * is_sensor[..., None] * within
    targets = torch.where(shown, mixed, by_regret)
    targets = targets * torch.where(failing[..., None] == 1, _AFTER_FAILURE, 1.0)
    return targets / targets.sum((1, 2), keepdim=True)


def _entries(text: str, sign_of: Mapping[str, int]) -> list[list[int]]:
    """A block's experiences: two digits around the sensor's sign, and whether the transmission failed."""
    return [
        [int(text[at]), sign_of[text[at + 1]], int(text[at + 2]), int(text[at + 3] == "X")]
        for at in range(0, len(text), 4)
    ]
