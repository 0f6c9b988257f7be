"""LoRA training of the embedded model on prompt examples."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from service.distilling.batches import Batches
from service.distilling.examples import PromptExample
from service.distilling.gguf_adapter import write_gguf_adapter
from service.distilling.loss import LETTERS, Outputs, Targets, answer_loss, loss_of
from service.distilling.options import Distill

_MATRICES = ["q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"]
_BASE = "HuggingFaceTB/SmolLM2-135M-Instruct"
# The tokens whose logits differ by a row's worth.
_WORTH = "09"
_WARM_UP_STEPS = 30
_MOST_GRADIENT = 1.0
_EVALUATION_BATCH = 64
_CHECKPOINT_STEPS = 50


class Student:
    """The embedded model with a LoRA adapter; its own weights, dequantised, stay as they are.

    Args:
        static: the prompts' static block.
        begin: a folder of an earlier adapter.
    """

    def __init__(self, gguf: Path, static: str, rank: int, device: str, begin: Path | None = None) -> None:
        # Their imports take seconds.
        from peft import LoraConfig, PeftModel, get_peft_model
        from transformers import AutoModelForCausalLM, AutoTokenizer, GgufConfig

        self._tokenizer: Any = AutoTokenizer.from_pretrained(gguf.parent, gguf_file=gguf.name)
        base = AutoModelForCausalLM.from_pretrained(
            gguf.parent,
            gguf_file=gguf.name,
            dtype=torch.bfloat16,
            quantization_config=GgufConfig(dequantize=True),
        )
        base.config.use_cache = False
        with warnings.catch_warnings():
            # peft 0.21 reads an attribute that transformers 5.23 has renamed.
            warnings.filterwarnings("ignore", "`is_gradient_checkpointing` is deprecated", FutureWarning)
            if begin is None:
                config = LoraConfig(r=rank, lora_alpha=2 * rank, target_modules=_MATRICES, bias="none")
                self.model: Any = get_peft_model(base, config)
            else:
                self.model = PeftModel.from_pretrained(base, begin, is_trainable=True)
        if device == "cpu":
            # torch's fused attention takes a quarter of a step on a CPU: its backward pass is slow for short prompts.
            self.model.base_model.model.set_attn_implementation("eager")
        self.model.to(device)
        self._device = torch.device(device)
        self._letter_ids: Any = self._tokenizer.convert_tokens_to_ids(list(LETTERS))
        self._letters = torch.tensor(self._letter_ids, device=self._device)
        self._worth = torch.tensor(self._tokenizer.convert_tokens_to_ids(list(_WORTH)), device=self._device)
        self._before, self._after = self._frame(static)

    def read(self, texts: Sequence[str]) -> Outputs:
        """The logits after each user message, and after the letter of each of its rows."""
        middles = self._tokenizer(list(texts), add_special_tokens=False).input_ids
        ids = [self._before + middle + self._after for middle in middles]
        longest = max(map(len, ids))
        tokens, mask = torch.zeros(2, len(ids), longest, dtype=torch.long)
        rows: list[tuple[int, int]] = []
        for number, (own, middle) in enumerate(zip(ids, middles, strict=True)):
            # On the left, so that the answer's position is the last of every prompt.
            begin = longest - len(own)
            tokens[number, begin:] = torch.tensor(own)
            mask[number, begin:] = 1
            first = begin + len(self._before)
            rows += [(number, first + place) for place, token in enumerate(middle) if token in self._letter_ids]
        prompts, places = torch.tensor(rows, device=self._device).T
        with torch.autocast(self._device.type, dtype=torch.bfloat16):
            hidden = self.model.base_model.model.model(
                input_ids=tokens.to(self._device),
                # Without padding the attention needs no mask.
                attention_mask=None if bool(mask.all()) else mask.to(self._device),
                position_ids=(mask.cumsum(1) - 1).clamp(min=0).to(self._device),
            ).last_hidden_state
            table = self.model.get_output_embeddings().weight
            after_row = hidden[prompts, places]
            answer, own_letter = (states @ table[self._letters].T for states in (hidden[:, -1], after_row))
            worst, best = (after_row @ table[self._worth].T).T
        return Outputs(answer.float(), own_letter.float(), (best - worst).float())

    def write_peft(self, folder: Path) -> None:
        """Write the adapter in Hugging Face's format, which names the model that the GGUF file was made of."""
        self.model.peft_config["default"].base_model_name_or_path = _BASE
        self.model.save_pretrained(folder, save_embedding_layers=False)

    def write_gguf(self, path: Path) -> None:
        """Write the adapter for llama.cpp."""
        config = self.model.config
        weights = {
            name.replace(".default", ""): weight.detach().float().cpu().numpy()
            for name, weight in self.model.named_parameters()
            if "lora_" in name
        }
        write_gguf_adapter(
            path,
            weights,
            alpha=self.model.peft_config["default"].lora_alpha,
            heads=config.num_attention_heads,
            kv_heads=config.num_key_value_heads,
        )

    def _frame(self, static: str) -> tuple[list[int], list[int]]:
        """The tokens of the chat before and after the user message."""
        mark = "0"
        whole = self._tokenizer.apply_chat_template(
            [{"role": "system", "content": static}, {"role": "user", "content": mark}],
            tokenize=False,
            add_generation_prompt=True,
        )
        head, _, tail = whole.rpartition(mark)
        return tuple(self._tokenizer(text, add_special_tokens=False).input_ids for text in (head, tail))


@dataclass(frozen=True, slots=True)
class Agreement:
    """How a student decides beside the teacher, over held-out decisions.

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
def agreement(student: Student, examples: Sequence[PromptExample]) -> Agreement:
    """The agreement over these examples; there is at least one."""
    student.model.eval()
    same, shown, share, loss = 0, 0, 0.0, 0.0
    for start in range(0, len(examples), _EVALUATION_BATCH):
        some = examples[start : start + _EVALUATION_BATCH]
        answer = student.read([example.text for example in some]).answer.cpu()
        targets = Targets.of(some)
        loss += float(answer_loss(answer, targets)) * len(some)
        best = answer.masked_fill(~targets.offered, -torch.inf).argmax(dim=1)
        for example, letter in zip(some, best.tolist(), strict=True):
            place = example.labels.index(LETTERS[letter])
            share += float(example.target[place])
            if example.reference >= 0:
                shown += 1
                same += example.sensors[place] == example.sensors[example.reference]
    student.model.train()
    return Agreement(len(examples), same / max(shown, 1), share / len(examples), loss / len(examples))


def train(
    student: Student, examples: Sequence[PromptExample], args: Distill, checkpoint: Path
) -> Generator[float, None, None]:
    """Train, and yield each step's loss; goes on from the checkpoint, which is written every fifty steps.

    Raises:
        ValueError: the checkpoint is of another run.
    """
    batches = Batches([len(example.text) for example in examples], args.batch, args.seed)
    weights = [p for p in student.model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=args.learning_rate, weight_decay=0.0)
    first = 0
    if checkpoint.is_file():
        found = torch.load(checkpoint, weights_only=True)
        if found["run"] != _run(examples, args):
            raise ValueError(f"{checkpoint} is of a run with other recordings or options: give --out another folder")
        first = found["step"]
        optimizer.load_state_dict(found["optimizer"])
        with torch.no_grad():
            for own, kept in zip(weights, found["weights"], strict=True):
                own.copy_(kept)
    student.model.train()
    for step in range(first, args.steps):
        for group in optimizer.param_groups:
            group["lr"] = args.learning_rate * _schedule(step, args.steps)
        some = [examples[i] for i in batches.of(step)]
        outputs = student.read([example.text for example in some])
        loss = loss_of(outputs, Targets.of(some, outputs.answer.device))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(weights, _MOST_GRADIENT)
        optimizer.step()
        if (step + 1) % _CHECKPOINT_STEPS == 0 or step + 1 == args.steps:
            half = checkpoint.with_suffix(".part")
            kept = {
                "run": _run(examples, args),
                "step": step + 1,
                "optimizer": optimizer.state_dict(),
                "weights": [weight.detach().cpu() for weight in weights],
            }
            torch.save(kept, half)
            half.replace(checkpoint)
        yield float(loss.detach())


def _run(examples: Sequence[PromptExample], args: Distill) -> str:
    """What determines a run's weights, as text."""
    texts = hashlib.sha256("\n".join(example.text for example in examples).encode()).hexdigest()
    return f"{texts} {args.begin} {args.steps} {args.batch} {args.rank} {args.learning_rate} {args.seed}"


def _schedule(step: int, steps: int) -> float:
    """The share of the learning rate: linear warm-up, then a cosine to a tenth."""
    if step < _WARM_UP_STEPS:
        return (step + 1) / _WARM_UP_STEPS
    done = (step - _WARM_UP_STEPS) / max(1, steps - _WARM_UP_STEPS)
    return 0.1 + 0.45 * (1.0 + math.cos(math.pi * done))
