"""The embedded LLM's adapters: one for decisions (``lab distill``), one for operators' notes (``lab distill-orders``).

Each is bound to one version of the prompt that it was trained on.
"""

import struct
from pathlib import Path
from typing import NamedTuple


class Version(NamedTuple):
    """A version of a prompt: the key and the number in the adapter's metadata, and where the adapter comes from."""

    key: str
    number: int
    setting: str
    command: str


# The version of the compact prompt; it changes whenever a text of that prompt does.
PROMPT_VERSION = 3
DECISIONS = Version("aicvds.prompt_version", PROMPT_VERSION, "AICVDS_LLM_ADAPTER", "python -m lab distill")
# The version of the form in which the adapter reads notes and writes orders.
ORDERS = Version("aicvds.orders_version", 1, "AICVDS_LLM_ORDERS", "python -m lab distill-orders")
_UINT32 = 4
# The metadata comes first in the file.
_METADATA_BYTES = 4096


class AdapterUnusable(RuntimeError):
    """The adapter's file does not exist, is none of this project, or was trained on another prompt."""


def check_adapter(adapter: Path, version: Version) -> None:
    """Check that an adapter was trained on the prompt that this edge writes.

    Raises:
        AdapterUnusable: it was not; the message names the remedy.
    """
    remedy = f"set {version.setting}=off, or train one with `{version.command}`"
    try:
        with adapter.open("rb") as file:
            metadata = file.read(_METADATA_BYTES)
    except OSError as error:
        raise AdapterUnusable(f"{adapter.name} cannot be read ({error.strerror}): {remedy}") from None
    key = version.key.encode()
    at = metadata.find(key) + len(key)
    if not metadata.startswith(b"GGUF") or at < len(key) or len(metadata) < at + 8:
        raise AdapterUnusable(f"{adapter.name} is no adapter of {version.command}: {remedy}")
    kind, trained_on = struct.unpack_from("<II", metadata, at)
    if kind != _UINT32 or trained_on != version.number:
        raise AdapterUnusable(
            f"{adapter.name} was trained on version {trained_on} of the prompt, "
            f"and this edge writes {version.number}: {remedy}"
        )
