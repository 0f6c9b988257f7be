"""The number format of the LLM's weights in training."""

from __future__ import annotations

import torch


def half_precision(device: str) -> torch.dtype:
    """bfloat16 where the device multiplies it fast: other processors take forty times as long as for float32."""
    known = torch.cpu.get_capabilities()
    fast = device != "cpu" or known.get("avx512_bf16", False) or known.get("amx_bf16", False)
    return torch.bfloat16 if fast else torch.float32
