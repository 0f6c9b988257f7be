"""Convert an adapter of :mod:`lab.adapter.train` to a file for llama.cpp, or such a file to ``adapter.npz``.

python -m lab.adapter.gguf_file runs/adapter/adapter.npz runs/adapter/adapter.gguf
python -m lab.adapter.gguf_file service/checkpoints/adapter.gguf runs/adapter/begin.npz
"""

from __future__ import annotations

import sys
from pathlib import Path

import gguf
import numpy as np

from lab.distilling.gguf_adapter import GgufAdapter
from service.llm.adapter_version import DECISIONS

_ALPHA = 32.0


def main() -> None:
    """Convert the first file to the second."""
    source, target = map(Path, sys.argv[1:3])
    if source.suffix == ".gguf":
        tensors = GgufAdapter.read(source).tensors
        np.savez_compressed(target, **{name: values.astype(np.float16) for name, values in tensors.items()})
        return
    writer = gguf.GGUFWriter(target, "llama")
    writer.add_string("general.type", "adapter")
    writer.add_string("adapter.type", "lora")
    writer.add_float32("adapter.lora.alpha", _ALPHA)
    writer.add_uint32(DECISIONS.key, DECISIONS.number)
    for name, values in np.load(source).items():
        writer.add_tensor(name, np.ascontiguousarray(values.astype(np.float16)))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


if __name__ == "__main__":
    main()
