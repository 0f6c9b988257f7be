"""Rendezvous hashing (Thaler and Ravishankar 1998, "Using Name-Based Mappings to Increase Hit Rates").

Processes that know the same names rank them alike for a key, in whatever order they list them. If a name is removed,
only its own keys move, evenly to the others; if it is added again, they return.
"""

from hashlib import blake2b


def weight(key: str, name: str) -> int:
    """The weight of a name for a key, 0 to 2^64 - 1; the name of the highest weight is the key's."""
    # The length keeps ("a", "bc") and ("ab", "c") apart.
    return int.from_bytes(blake2b(f"{len(key)}:{key}{name}".encode(), digest_size=8).digest())
