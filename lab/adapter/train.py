"""Train the adapter for any number of rows on one large GPU, for so many seconds.

    python -m lab.adapter.train --records lab/adapter/decisions.npz --base runs/base --seconds 480 --out runs/adapter

It needs torch and numpy. ``adapter.npz`` has the adapter's tensors by GGUF name; ``python -m lab.adapter.gguf_file``
makes the file for llama.cpp of them.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from lab.adapter.batches import PromptBatch, PromptTokens, RecordTensors
from lab.adapter.model import Model

# How often a prompt may show at most 1, 2, ... 10 rows.
_SHARES = np.array([2, 3, 11, 6, 33, 5, 14, 5, 5, 16], dtype=float)
_EXPERIENCED_SHARE = 0.6
_TOKENS_A_STEP = 24_000
_RANK, _WARM_UP, _LEAST_RATE = 16, 60, 0.02
_ROWS_EVALUATED, _MOST_EVALUATED = (3, 5, 7, 10), 4000
_TINY = 1e-9


def loss_of(model: Model, tokens: PromptTokens, batch: PromptBatch) -> Tensor:
    """The loss of :mod:`lab.distilling.loss`: the answer, its sensor, each row's letter and each row's worth."""
    rows, options = batch.targets.shape[1:]
    states = model(batch.tokens)
    answers = model.logits(states[:, -1], tokens.letters[: rows * options]).log_softmax(1).view(batch.targets.shape)
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
    return answer + sensor + row + value


@torch.no_grad()
def evaluation(model: Model, tokens: PromptTokens, records: RecordTensors, device: str) -> str:
    """Held-out decisions: the packets lost above the best option, and how often the sensor is the planner's."""
    drawn = torch.Generator(device).manual_seed(1)
    lines = []
    for k in _ROWS_EVALUATED:
        regret, same = [], []
        for rows, which in records.groups(k, 0, held_out=True).items():
            for some in which[:_MOST_EVALUATED].split(512):
                batch = records.batch(some, k, rows, 0, drawn)
                with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
                    states = model(batch.tokens)[:, -1]
                options = batch.targets.shape[2]
                chosen = model.logits(states.float(), tokens.letters[: rows * options]).argmax(1, keepdim=True)
                regret.append(batch.regret.flatten(1).gather(1, chosen)[:, 0])
                shown = batch.planned.flatten(1).any(1)
                same.append(batch.planned.any(2).gather(1, chosen // options)[shown, 0].float())
        found = torch.cat(regret)
        lines.append(f"k = {k}: regret {found.mean():.3f}, same sensor {torch.cat(same).mean():.3f}, n = {len(found)}")
    return "\n".join(lines)


def train(model: Model, tokens: PromptTokens, records: RecordTensors, seconds: float, rate: float, device: str) -> None:
    """Train for a time; the learning rate follows it along a cosine."""
    draws, drawn = np.random.default_rng(0), torch.Generator(device).manual_seed(0)
    weights = [weight for weight in model.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=rate, betas=(0.9, 0.98), weight_decay=0.0)
    many = np.bincount(records.experiences[records.training].cpu(), minlength=9) * np.where(
        np.arange(9), _EXPERIENCED_SHARE, 1.0
    )
    begun, step = time.monotonic(), 0
    while (done := (time.monotonic() - begun) / seconds) < 1.0:
        k = int(draws.choice(10, p=_SHARES / _SHARES.sum())) + 1
        experiences = int(draws.choice(9, p=many / many.sum()))
        groups = records.groups(k, experiences)
        sizes = np.array([len(own) for own in groups.values()], dtype=float)
        rows = list(groups)[int(draws.choice(len(groups), p=sizes / sizes.sum()))]
        fixed = len(tokens.before) + len(tokens.after) + 7
        count = _TOKENS_A_STEP // (fixed + 4 * experiences + 10 * rows)
        own = groups[rows]
        which = own[torch.randint(len(own), (count,), device=device, generator=drawn)]
        fallen = _LEAST_RATE + (1 - _LEAST_RATE) * 0.5 * (1 + math.cos(math.pi * done))
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / _WARM_UP) * fallen
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            loss = loss_of(model, tokens, records.batch(which, k, rows, experiences, drawn))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        step += 1
        if step % 100 == 0:
            print(f"{step} steps, {time.monotonic() - begun:.0f} s: loss {float(loss):.3f}", flush=True)


def main() -> None:
    """Train, evaluate before and after, and write the adapter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", required=True, type=Path)
    parser.add_argument("--base", required=True, type=Path)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--begin", type=Path, help="an earlier adapter.npz; by default the adapter begins at zero")
    parser.add_argument("--seconds", type=float, default=480.0)
    parser.add_argument("--rate", type=float, default=8e-4)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    tensors = {name: values for number in (0, 1) for name, values in np.load(args.base / f"base{number}.npz").items()}
    kinds = json.loads((args.base / "tokens.json").read_text())["kinds"]
    dtype = torch.bfloat16 if device == "cuda" else torch.float32
    model, tokens = Model(tensors, kinds, _RANK, dtype).to(device), PromptTokens(args.base / "tokens.json", device)
    if args.begin is not None:
        model.load_adapter(np.load(args.begin))
    records = RecordTensors(np.load(args.records), tokens, device)
    print(evaluation(model, tokens, records, device), flush=True)
    train(model, tokens, records, args.seconds, args.rate, device)
    np.savez_compressed(args.out / "adapter.npz", **model.adapter())
    print(evaluation(model, tokens, records, device), flush=True)


if __name__ == "__main__":
    main()
