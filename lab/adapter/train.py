"""Train the adapter for any number of rows, on one large GPU or on a processor, for a given time.

    python -m lab.adapter.train --records lab/adapter/decisions.npz --base runs/base --seconds 480 --out runs/adapter
    python -m lab.adapter.train --records lab/adapter/*.npz --base runs/base --begin runs/begin.npz --seconds 3600 \
        --tokens 6000 --part 3000 --rate 4e-4 --out runs/adapter

It needs torch and numpy. ``adapter.npz`` has the adapter's tensors by GGUF name; ``python -m lab.adapter.gguf_file``
makes the file for llama.cpp from it. The same command resumes from ``checkpoint.pt``, which it writes each minute.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from lab.adapter.batches import PromptBatch, PromptTokens, RecordTensors
from lab.adapter.model import Layer, Model

# The weights of the prompts with at most 1, 2, ... 10 rows.
_SHARES = np.array([2, 3, 20, 6, 30, 5, 12, 4, 4, 14], dtype=float)
_EXPERIENCED_SHARE = 0.6
_WARM_UP, _LEAST_RATE = 60, 0.02
_ROWS_EVALUATED = (3, 5, 7, 10)
_TINY, _TINY_LOGIT = 1e-9, 1e-3
_CHECKPOINT_S = 60.0


def loss_of(model: Model, layers: Sequence[Layer], tokens: PromptTokens, batch: PromptBatch) -> Tensor:
    """The loss of :mod:`lab.distilling.loss`: the answer, its sensor, each row's letter and each row's worth.

    A further term is the probability, among all tokens, of an offered letter as the answer, because most LLM servers
    do not constrain it.
    """
    rows, options = batch.targets.shape[1:]
    states = model(batch.tokens, layers)
    letters = model.logits(states[:, -1], tokens.letters[: rows * options])
    offered = letters.logsumexp(1) - model.all_logits(states[:, -1]).logsumexp(1)
    answers = letters.log_softmax(1).view(batch.targets.shape)
    worth = batch.targets.sum(2)
    answer = -(batch.targets * answers).sum((1, 2)).mean()
    sensor = -(worth * (answers.exp().sum(2) + _TINY).log()).sum(1).mean()
    after_row = states[:, batch.letters_at]
    logits = model.logits(after_row, tokens.letters[: rows * options]).unflatten(2, (rows, options))
    own = logits.diagonal(dim1=1, dim2=2).movedim(-1, 1).log_softmax(2)
    within = batch.targets / (worth[..., None] + _TINY)
    row = ((0.5 + 2.0 * worth) * -(within * own).sum(2)).mean()
    worst, best = model.logits(after_row, tokens.digits[[0, 9]]).unbind(2)
    value = binary_cross_entropy_with_logits(best - worst, worth.clamp(max=1.0))
    return answer + sensor + row + value - offered.mean()


@torch.no_grad()
def evaluation(model: Model, tokens: PromptTokens, records: RecordTensors, most: int, device: str) -> str:
    """Held-out decisions: the packets lost above the best option, how often the sensor is the planner's, and how often
    the likeliest of all tokens is an offered letter."""
    drawn = torch.Generator(device).manual_seed(1)
    lines, layers = [], model.layers()
    for k in _ROWS_EVALUATED:
        regret, same, offered = [], [], []
        for rows, which in records.groups(k, 0, held_out=True).items():
            for part in which[:most].split(512 if device == "cuda" else 32):
                batch = records.batch(part, k, rows, 0, drawn)
                states = model(batch.tokens, layers)[:, -1]
                options = batch.targets.shape[2]
                logits = model.logits(states, tokens.letters[: rows * options])
                # The two products differ by rounding.
                offered.append(logits.amax(1) >= model.all_logits(states).amax(1) - _TINY_LOGIT)
                chosen = logits.argmax(1, keepdim=True)
                regret.append(batch.regret.flatten(1).gather(1, chosen)[:, 0])
                shown = batch.planned.flatten(1).any(1)
                same.append(batch.planned.any(2).gather(1, chosen // options)[shown, 0].float())
        found = torch.cat(regret)
        lines.append(
            f"k = {k}: regret {found.mean():.3f}, same sensor {torch.cat(same).mean():.3f}, "
            f"an offered letter {torch.cat(offered).float().mean():.3f}, n = {len(found)}"
        )
    return "\n".join(lines)


class Draws:
    """Random batches, each of prompts with the same numbers of rows and experiences."""

    def __init__(self, tokens: PromptTokens, records: RecordTensors, device: str, seed: int) -> None:
        self._records = records
        self._draws, self._drawn = np.random.default_rng(seed), torch.Generator(device).manual_seed(seed)
        self._fixed = len(tokens.before) + len(tokens.after) + 7
        many = np.bincount(records.experiences[records.training].cpu(), minlength=9)
        self._experiences = many * np.where(np.arange(9), _EXPERIENCED_SHARE, 1.0)

    def batch(self, size: int) -> PromptBatch:
        """A batch of about ``size`` tokens."""
        k = int(self._draws.choice(10, p=_SHARES / _SHARES.sum())) + 1
        experiences = int(self._draws.choice(9, p=self._experiences / self._experiences.sum()))
        groups = self._records.groups(k, experiences)
        sizes = np.array([len(own) for own in groups.values()], dtype=float)
        rows = list(groups)[int(self._draws.choice(len(groups), p=sizes / sizes.sum()))]
        own = groups[rows]
        count = size // (self._fixed + 4 * experiences + 10 * rows)
        which = own[torch.randint(len(own), (count,), device=own.device, generator=self._drawn)]
        return self._records.batch(which, k, rows, experiences, self._drawn)


def train(model: Model, tokens: PromptTokens, records: RecordTensors, args: argparse.Namespace, device: str) -> None:
    """Train for a time, or for its rest after the checkpoint; the learning rate falls along a cosine."""
    weights = [weight for weight in model.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=args.rate, betas=(0.9, 0.98), weight_decay=0.0)
    spent_s, step, checkpoint = 0.0, 0, args.out / "checkpoint.pt"
    if checkpoint.is_file():
        found = torch.load(checkpoint, weights_only=True)
        spent_s, step = found["spent"], found["step"]
        model.load_state_dict(found["model"], strict=False)
        optimizer.load_state_dict(found["optimizer"])
    draws = Draws(tokens, records, device, step)
    begun = written = time.monotonic()
    losses: list[float] = []
    while (done := (spent_s + time.monotonic() - begun) / args.seconds) < 1.0:
        fallen = _LEAST_RATE + (1 - _LEAST_RATE) * 0.5 * (1 + math.cos(math.pi * done))
        for group in optimizer.param_groups:
            group["lr"] = args.rate * min(1.0, (step + 1) / _WARM_UP) * fallen
        optimizer.zero_grad()
        layers, parts = model.layers(), max(1, args.tokens // args.part)
        for _ in range(parts):
            loss = loss_of(model, layers, tokens, draws.batch(args.part)) / parts
            loss.backward()
            losses.append(float(loss.detach()) * parts)
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        step += 1
        now = time.monotonic()
        if now - written >= _CHECKPOINT_S:
            written, half = now, checkpoint.with_suffix(".part")
            own = {name: weight for name, weight in model.named_parameters() if weight.requires_grad}
            torch.save(
                {"spent": spent_s + now - begun, "step": step, "model": own, "optimizer": optimizer.state_dict()}, half
            )
            half.replace(checkpoint)
            print(f"{step} steps, {spent_s + now - begun:.0f} s: loss {np.mean(losses):.3f}", flush=True)
            losses = []


def main() -> None:
    """Train, evaluate before and after, and write the adapter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", required=True, type=Path, nargs="+", help="a file given twice counts twice")
    parser.add_argument("--base", required=True, type=Path)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--begin", type=Path, help="an earlier adapter.npz; by default the adapter begins at zero")
    parser.add_argument("--seconds", type=float, default=480.0)
    parser.add_argument("--rate", type=float, default=8e-4)
    parser.add_argument("--tokens", type=int, default=24_000, help="of a step")
    parser.add_argument("--part", type=int, default=24_000, help="tokens that are read at once")
    parser.add_argument("--evaluated", type=int, default=4000, help="held-out decisions for each number of rows")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    model, tokens = Model.of(args.base, device), PromptTokens(args.base / "tokens.json", device)
    if args.begin is not None:
        model.load_adapter(np.load(args.begin))
    parts = [np.load(file) for file in args.records]
    records = RecordTensors({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, tokens, device)
    print(evaluation(model, tokens, records, args.evaluated, device), flush=True)
    train(model, tokens, records, args, device)
    np.savez_compressed(args.out / "adapter.npz", **model.adapter())
    print(evaluation(model, tokens, records, args.evaluated, device), flush=True)


if __name__ == "__main__":
    main()
