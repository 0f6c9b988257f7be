"""A stored flight of one scheme on one world, and the folder of stored flights."""

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

import numpy as np

from lab.experiments.schemes import Scheme
from shared.planning.guidance_messages import GuidanceState
from shared.planning.orders import Guidance
from simulator.records.decision import Record
from simulator.records.run_folder import naming_out
from simulator.sites.site import Site
from simulator.world.gain_trace import GainTrace

# Part of every key: increment it when the content or the meaning of a stored flight changes.
FORMAT = 1
_TORN_S = 3600.0


class TokenCounts(Record):
    """Token counts of one decision; see ``shared.wire.schemas.Tokens``."""

    prompt: int
    uncompressed: int
    state: int
    state_uncompressed: int
    cached: int | None = None
    completion: int | None = None


class DecisionRecord(Record):
    """One decision and its outcome; the last five fields are ``None`` or empty for a decision without an edge.

    ``trust`` is the weight of each adviser before a decision of mode ``guided``, and empty in flights that were stored
    before it was recorded.
    """

    step: int
    uav: int
    sensor: int
    velocity: int
    failed: bool
    collected: int
    source: str
    reason: str | None = None
    tokens: TokenCounts | None = None
    rtt_ms: float | None = None
    latency_ms: dict[str, float] = {}
    trust: dict[str, float] = {}


class BoundFound(Record):
    """The clairvoyant bound of one world, packets; see ``simulator.bound.clairvoyant_bound``."""

    lower_bound: float
    lost_packets: int
    optimal: bool
    gap: float


class FlightRecord(Record):
    """One flight. ``failures``, ``overflows`` and ``lost_packets`` have one entry a step.

    For the bound the lists are empty and ``bound`` is set. ``commit`` is that of the code at the flight. With an
    operator, ``meant`` is the guidance intended, and ``guidance`` is its state at the edge.
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
    decisions: list[DecisionRecord] = []
    bound: BoundFound | None = None
    meant: Guidance | None = None
    guidance: GuidanceState | None = None


def flight_key(scheme: Scheme, identity: str | None, site: Site, seed: int) -> str:
    """The identity of a flight as a hash: the scheme's decider without its name, the site, and the seed.

    Args:
        identity: of the decider beyond the scheme: the LLM behind the edge, or a network's weights.
    """
    arrivals = None if site.arrivals is None else hashlib.sha256(site.arrivals.tobytes()).hexdigest()
    decides: dict[str, Any] = scheme.decides.model_dump(mode="json")
    for newer in ("operator", "sensor_uplinks"):
        # So flights without an operator keep the keys of versions without operators.
        if decides.get(newer) is None:
            decides.pop(newer, None)
    scenario = site.scenario.model_dump(mode="json")
    if scenario["initial_queue_max"] == 1:
        del scenario["initial_queue_max"]
    if identity is not None:
        decides["identity"] = identity
    whole = {
        "format": FORMAT,
        "decides": decides,
        "scenario": scenario,
        "arrivals": arrivals,
        "seed": seed,
    }
    if site.gains is not None:
        whole["gains"] = _digest(site.gains)
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:24]


def _digest(gains: GainTrace) -> str:
    found = hashlib.sha256()
    for pair, (along, loss) in sorted(gains.points.items()):
        found.update(np.array([*pair, len(along)], dtype=np.int64).tobytes() + along.tobytes() + loss.tobytes())
    return found.hexdigest()


class FlightStore:
    """Flights in a folder, each in one gzipped JSON file that is written atomically.

    Raises:
        UsageError: the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with naming_out(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for torn in folder.glob(".*.part"):
                # A recent file may belong to another run that writes now; an old one is of a killed run.
                if time.time() - torn.stat().st_mtime > _TORN_S:
                    torn.unlink(missing_ok=True)

    def path(self, key: str) -> Path:
        """The path of the flight with that key."""
        return self._folder / f"{key}.json.gz"

    def load(self, key: str) -> FlightRecord | None:
        """The flight with that key; ``None`` if its file is missing or broken."""
        try:
            return FlightRecord.model_validate_json(gzip.decompress(self.path(key).read_bytes()))
        except (OSError, EOFError, ValueError, zlib.error):
            return None

    def save(self, key: str, flight: FlightRecord) -> None:
        """Store a flight; raises ``UsageError`` if it cannot be written."""
        part = self._folder / f".{key}.{os.getpid()}.part"
        with naming_out(self._folder):
            part.write_bytes(gzip.compress(flight.model_dump_json(exclude_defaults=True).encode(), mtime=0))
            os.replace(part, self.path(key))
