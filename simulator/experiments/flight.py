"""A flight: one scheme on one world, as an experiment keeps it, and the folder where flights are kept."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import time
import zlib
from datetime import datetime
from pathlib import Path
from typing import Any

from shared.guidance import Guidance, GuidanceState
from simulator.experiments.schemes import Scheme
from simulator.records.record import Record
from simulator.records.run_folder import naming_out
from simulator.sites.site import Site

# Part of every key: raise it when what a flight keeps, or means, changes.
FORMAT = 1
_TORN_S = 3600.0


class Counted(Record):
    """Token counts of one decision; see ``shared.wire.Tokens``."""

    prompt: int
    uncompressed: int
    state: int
    state_uncompressed: int
    cached: int | None = None
    completion: int | None = None


class Decided(Record):
    """One decision and what came of it; the last four are ``None`` or empty of a decision without an edge."""

    step: int
    uav: int
    sensor: int
    velocity: int
    failed: bool
    collected: int
    source: str
    reason: str | None = None
    tokens: Counted | None = None
    rtt_ms: float | None = None
    latency_ms: dict[str, float] = {}


class BoundFound(Record):
    """The clairvoyant bound of one world, packets; see ``simulator.flying.clairvoyant_bound``."""

    lower_bound: float
    lost_packets: int
    optimal: bool
    gap: float


class Flown(Record):
    """One flight. ``failures``, ``overflows`` and ``lost_packets`` have one entry a step.

    Of the bound the lists are empty and ``bound`` is there. ``commit`` is the code's that flew it. Where an operator
    asked for something, ``meant`` is what, and ``guidance`` how the edge took it.
    """

    seed: int
    scenario: str
    steps: int
    sensors: int
    uavs: int
    model: str | None
    commit: str | None
    flown_at: datetime
    duration_s: float
    failures: list[int] = []
    overflows: list[int] = []
    lost_packets: list[int] = []
    decisions: list[Decided] = []
    bound: BoundFound | None = None
    meant: Guidance | None = None
    guidance: GuidanceState | None = None


def flight_key(scheme: Scheme, identity: str | None, site: Site, seed: int) -> str:
    """What makes a flight that flight, as a hash: who decides (not what they are called), where, and the seed.

    Args:
        identity: what of who decides the scheme does not say: the LLM behind the edge, or a network's weights.
    """
    arrivals = None if site.arrivals is None else hashlib.sha256(site.arrivals.tobytes()).hexdigest()
    decides: dict[str, Any] = scheme.decides.model_dump(mode="json")
    if decides.get("operator") is None:
        # Flights without one keep the key that they had before there were any.
        decides.pop("operator", None)
    if identity is not None:
        decides["identity"] = identity
    whole = {
        "format": FORMAT,
        "decides": decides,
        "scenario": site.scenario.model_dump(mode="json"),
        "arrivals": arrivals,
        "seed": seed,
    }
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:24]


class FlightStore:
    """Flights in a folder, one gzipped JSON file each; a file is there whole or not at all.

    Raises:
        UsageError: the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with naming_out(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for torn in folder.glob(".*.part"):
                # Another run may be writing here now; what a killed one left is old.
                if time.time() - torn.stat().st_mtime > _TORN_S:
                    torn.unlink(missing_ok=True)

    def path(self, key: str) -> Path:
        """Where the flight of that key is, or would be."""
        return self._folder / f"{key}.json.gz"

    def load(self, key: str) -> Flown | None:
        """The flight of that key; ``None`` if it is not there or its file is broken, and must be flown."""
        try:
            return Flown.model_validate_json(gzip.decompress(self.path(key).read_bytes()))
        except (OSError, EOFError, ValueError, zlib.error):
            return None

    def save(self, key: str, flight: Flown) -> None:
        """Keep a flight; raises ``UsageError`` if it cannot be written."""
        part = self._folder / f".{key}.{os.getpid()}.part"
        with naming_out(self._folder):
            part.write_bytes(gzip.compress(flight.model_dump_json(exclude_defaults=True).encode(), mtime=0))
            os.replace(part, self.path(key))
