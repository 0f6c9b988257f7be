"""The embedded LLM's adapter: a file of ``aicvds distill``, bound to one version of the compact prompt."""

from __future__ import annotations

import struct
from pathlib import Path

# The version of the compact prompt; it changes whenever a text of that prompt does.
PROMPT_VERSION = 3
# The key of the adapter's metadata, in GGUF a name, a type and a value.
VERSION_KEY = "aicvds.prompt_version"
_UINT32 = 4
# The metadata comes first in the file.
_METADATA_BYTES = 4096


class AdapterUnusable(RuntimeError):
    """The adapter's file does not exist, is none of this project, or was trained on another prompt."""


def check_adapter(adapter: Path) -> None:
    """Check that an adapter was trained on the compact prompt that this edge writes.

    Raises:
        AdapterUnusable: it was not; the message names the remedy.
    """
    remedy = "set AICVDS_LLM_ADAPTER=off, or train one with `aicvds distill`"
    try:
        with adapter.open("rb") as file:
            metadata = file.read(_METADATA_BYTES)
    except OSError as error:
        raise AdapterUnusable(f"{adapter.name} cannot be read ({error.strerror}): {remedy}") from None
    key = VERSION_KEY.encode()
    at = metadata.find(key) + len(key)
    if not metadata.startswith(b"GGUF") or at < len(key) or len(metadata) < at + 8:
        raise AdapterUnusable(f"{adapter.name} is no adapter of aicvds distill: {remedy}")
    kind, trained_on = struct.unpack_from("<II", metadata, at)
    if kind != _UINT32 or trained_on != PROMPT_VERSION:
        raise AdapterUnusable(
            f"{adapter.name} was trained on version {trained_on} of the prompt, "
            f"and this edge writes {PROMPT_VERSION}: {remedy}"
        )
