"""The settings of one simulated mission."""

import secrets
from dataclasses import dataclass
from pathlib import Path

from shared.wire.schemas import Mode, Uplink
from shared.world.scenario import Scenario
from simulator.sites.site import Site

BASELINES = ("eof", "wqcs")
EDGE_MODE = "edge:"
# Seconds of search for the bound on a mission's losses. Scenario `paper` takes about one.
BOUND_S = 10.0


def new_mission_id(scenario: Scenario, seed: int) -> str:
    """A new, unique ID such as ``paper-0-1f6c09ab``."""
    return f"{scenario.name}-{seed}-{secrets.token_hex(4)}"


@dataclass(frozen=True)
class Job:
    """The settings of one simulated mission.

    ``policy`` is ``edge`` or a local policy's name, and then ``edge`` is asked for the comparison alone. A ``named``
    mission may exist at the edge before the flight. ``note`` is the operator's. Before take-off the mission waits, at
    most ``wait_s`` seconds, while the LLM's state is one of ``wait_out``. After the flight the bound on its losses is
    searched for ``bound_s`` seconds at most; 0 searches none. ``reference`` is a mode without an LLM in which the same
    edge flies the same world once more, after a mission whose mode has one. The policies ``against`` fly the same world
    for comparison: local ones, and modes of the edge as ``edge:MODE``. With ``pace`` a step takes as long as in the
    world, divided by ``pace``.
    """

    site: Site
    seed: int
    mission_id: str
    out: Path
    command: str
    policy: str = "edge"
    edge: str | None = None
    mode: Mode | None = None
    note: str | None = None
    named: bool = False
    uplink: Uplink = "full"
    deadline_ms: int | None = None
    wait_s: float = 120.0
    wait_out: tuple[str, ...] = ("loading",)
    reconnect_s: float = 0.0
    bound_s: float = BOUND_S
    reference: Mode | None = None
    against: tuple[str, ...] = BASELINES
    pace: float | None = None
