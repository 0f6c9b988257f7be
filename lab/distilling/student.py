"""The embedded model as a student: in torch, with a LoRA adapter that learns."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, from_numpy
from torch.nn.functional import linear

from lab.distilling.gguf_adapter import GgufAdapter, write_gguf_adapter
from lab.precision import half_precision
from service.llm.adapter_version import Version

_MATRICES = ["q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"]
_BASE = "HuggingFaceTB/SmolLM2-135M-Instruct"


class Student:
    """The embedded model with a LoRA adapter; its own weights, dequantised, stay as they are.

    Args:
        static: the prompts' static block.
        begin: an earlier adapter, as a folder that peft wrote or as a GGUF file; its rank counts.

    Raises:
        OSError: the earlier adapter cannot be read.
        ValueError: it is none of this model.

    Attributes:
        tokenizer: the model's.
        before, after: the tokens of a chat before and after the user message.
    """

    def __init__(self, gguf: Path, static: str, rank: int, device: str, begin: Path | None = None) -> None:
        # Loading the model takes longer than the check of this file.
        earlier = None if begin is None or begin.is_dir() else GgufAdapter.read(begin)
        # Their imports take seconds.
        from peft import LoraConfig, PeftModel, get_peft_model, set_peft_model_state_dict
        from transformers import AutoModelForCausalLM, AutoTokenizer, GgufConfig

        self.tokenizer: Any = AutoTokenizer.from_pretrained(gguf.parent, gguf_file=gguf.name)
        base = AutoModelForCausalLM.from_pretrained(
            gguf.parent,
            gguf_file=gguf.name,
            dtype=(dtype := half_precision(device)),
            quantization_config=GgufConfig(dequantize=True),
        )
        base.config.use_cache = False
        with warnings.catch_warnings():
            # peft 0.21 reads an attribute that transformers 5.23 has renamed.
            warnings.filterwarnings("ignore", "`is_gradient_checkpointing` is deprecated", FutureWarning)
            if begin is not None and earlier is None:
                self.model: Any = PeftModel.from_pretrained(base, begin, is_trainable=True)
            else:
                rank, alpha = (rank, 2.0 * rank) if earlier is None else (earlier.rank, earlier.alpha)
                config = LoraConfig(r=rank, lora_alpha=round(alpha), target_modules=_MATRICES, bias="none")
                self.model = get_peft_model(base, config)
            if earlier is not None:
                weights = earlier.weights(**_heads(base.config))
                try:
                    set_peft_model_state_dict(self.model, {name: from_numpy(own) for name, own in weights.items()})
                except RuntimeError as mismatch:
                    raise ValueError(f"{begin} is no adapter of {gguf.name}: {mismatch}") from None
        if device == "cpu":
            # torch's fused attention takes a quarter of a step on a CPU: its backward pass is slow for short prompts.
            self.model.base_model.model.set_attn_implementation("eager")
        self.model.to(device)
        self.device = torch.device(device)
        self._half = dtype == torch.bfloat16
        self.before, self.after = self._frame(static)

    def read(self, ids: Sequence[Sequence[int]], prefix: Sequence[int] = ()) -> Tensor:
        """The last layer's states for B lists of tokens, at most T long: shape ``(B, T, width)``.

        Shorter lists are padded on the left, so that a list's last token is at the last place.

        Args:
            prefix: tokens before each list, which are read once and without a gradient.
        """
        longest = max(map(len, ids))
        tokens, mask = torch.zeros(2, len(ids), longest, dtype=torch.long)
        for number, own in enumerate(ids):
            tokens[number, longest - len(own) :] = torch.tensor(own)
            mask[number, longest - len(own) :] = 1
        places = (mask.cumsum(1) - 1).clamp(min=0) + len(prefix)
        whole = torch.cat((torch.ones(len(ids), len(prefix), dtype=torch.long), mask), dim=1)
        with self._precision():
            states: Tensor = self.model.base_model.model.model(
                input_ids=tokens.to(self.device),
                # Without padding the attention needs no mask.
                attention_mask=None if bool(mask.all()) else whole.to(self.device),
                position_ids=places.to(self.device),
                past_key_values=self._read_before(prefix, len(ids)) if prefix else None,
            ).last_hidden_state
        return states

    @torch.no_grad()
    def _read_before(self, prefix: Sequence[int], lists: int) -> Any:
        """The attention's cache of a prefix, for ``lists`` lists of tokens."""
        read = self.model.base_model.model.model(torch.tensor([list(prefix)], device=self.device), use_cache=True)
        read.past_key_values.batch_repeat_interleave(lists)
        return read.past_key_values

    def logits(self, states: Tensor, tokens: Tensor | None = None) -> Tensor:
        """The logits of these tokens, or of all, after states of shape ``(..., width)``."""
        table = self.model.get_output_embeddings().weight
        with self._precision():
            found: Tensor = linear(states, table if tokens is None else table[tokens])
        return found.float()

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self._half)

    def write_peft(self, folder: Path) -> None:
        """Write the adapter in Hugging Face's format, which names the model that the GGUF file was made of."""
        self.model.peft_config["default"].base_model_name_or_path = _BASE
        self.model.save_pretrained(folder, save_embedding_layers=False)

    def write_gguf(self, path: Path, version: Version) -> None:
        """Write the adapter for llama.cpp, with the version of the prompt that it was trained on."""
        weights = {
            name.replace(".default", ""): weight.detach().float().cpu().numpy()
            for name, weight in self.model.named_parameters()
            if "lora_" in name
        }
        write_gguf_adapter(
            path,
            weights,
            version,
            alpha=self.model.peft_config["default"].lora_alpha,
            **_heads(self.model.config),
        )

    def _frame(self, static: str) -> tuple[list[int], list[int]]:
        """The tokens of the chat before and after the user message."""
        mark = "0"
        whole = self.tokenizer.apply_chat_template(
            [{"role": "system", "content": static}, {"role": "user", "content": mark}],
            tokenize=False,
            add_generation_prompt=True,
        )
        head, _, tail = whole.rpartition(mark)
        before, after = self.tokenizer([head, tail], add_special_tokens=False).input_ids
        return before, after


def _heads(config: Any) -> dict[str, int]:
    """The attention heads of a model."""
    return {"heads": config.num_attention_heads, "kv_heads": config.num_key_value_heads}
