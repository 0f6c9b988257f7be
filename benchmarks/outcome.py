"""What a mission loses, by who decides: an edge over HTTP beside the baselines, on the same worlds.

    python benchmarks/outcome.py --edge http://localhost:8000 --label llm --seeds 10

Prints lost packets and loss events a mission with 95% bootstrap intervals over seeds, and each scheme's packets as a
ratio to EOF's on the same worlds; writes the same, seed by seed, as JSON. The deadline is generous on purpose: this
measures what is decided, not how fast the machine is.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import bootstrap

from shared.scenario import Scenario, scenario_named
from shared.wire import Init, Mode
from simulator.client import EdgeClient
from simulator.mission import EdgePilot, fly, new_mission_id
from simulator.policies import POLICY_NAMES, Policy, policy_named
from simulator.rollout import rollout
from simulator.site import Site
from simulator.world import Observation, PipelineWorld

_DEADLINE_MS = 30_000


class FullSpeed:
    """Another policy's sensors at the scenario's full speed, to tell scheduling from flying fast."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def reset(self, scenario: Scenario, seed: int) -> None:
        """Start a mission."""
        self._policy.reset(scenario, seed)
        self._velocity = scenario.max_velocity

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> tuple[int, int]:
        """The policy's sensor, full speed."""
        return self._policy.decide(uav, observation, taken)[0], self._velocity


@dataclass(frozen=True)
class Outcome:
    """Fly the same worlds with an edge and with every baseline, and compare what they lose."""

    edge: str
    """The edge's address."""
    label: str
    """What to call this edge's way of deciding, such as llm or value."""
    seeds: int = 10
    """Worlds: seeds 0 to this number less one."""
    scenario: str = "paper"
    """The world."""
    mode: Mode | None = None
    """How the edge decides; default: its own setting."""
    init: Init = "pretrained"
    """The modules' start."""
    out: Path = Path("runs/outcome.json")
    """Where to write; schemes already there, of other labels, are kept and shown beside."""


def main(args: Outcome) -> int:
    """Fly, print, write."""
    scenario = scenario_named(args.scenario)
    lost: dict[str, list[list[int]]] = {}
    with EdgeClient(args.edge, timeout_s=_DEADLINE_MS / 1e3 + 5) as client:
        client.wait_ready(120)
        flown = []
        for seed in track(range(args.seeds), description=f"flying {args.label}"):
            mission_id = new_mission_id(scenario, seed)
            pilot = EdgePilot(client, mission_id, scenario, seed, mode=args.mode, deadline_ms=_DEADLINE_MS)
            pilot.spec = pilot.spec.model_copy(update={"init": args.init})
            client.put_mission(mission_id, pilot.spec)
            flight = fly(Site(scenario), pilot, seed)
            if flight.interrupted:
                return 130
            flown.append([sum(t.lost_packets for t in flight.tally), sum(t.events for t in flight.tally)])
        lost[args.label] = flown
    schemes: dict[str, Policy] = {name: policy_named(name) for name in POLICY_NAMES}
    schemes |= {f"{name} at full speed": FullSpeed(policy_named(name)) for name in ("eof", "wqcs")}
    for name, policy in schemes.items():
        tallies = [rollout(PipelineWorld(scenario), policy, seed) for seed in range(args.seeds)]
        lost[name] = [[sum(t.lost_packets for t in tally), sum(t.events for t in tally)] for tally in tallies]
    if args.out.exists():
        earlier = json.loads(args.out.read_text())["lost_packets_and_events"]
        lost = {**{k: v for k, v in earlier.items() if len(v) == args.seeds}, **lost}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(
        json.dumps({"scenario": args.scenario, "command": sys.argv, "lost_packets_and_events": lost}, indent=1)
    )
    Console().print(_table(lost, args))
    return 0


def _table(lost: dict[str, list[list[int]]], args: Outcome) -> Table:
    table = Table(
        "decides", "lost packets", "loss events", "packets / EOF's", title=f"{args.scenario}, {args.seeds} seeds"
    )
    eof = np.array(lost["eof"])[:, 0]
    for name, rows in sorted(lost.items(), key=lambda item: np.mean(item[1], axis=0)[0]):
        packets, events = np.array(rows).T
        if name == "eof":
            table.add_row(name, _mean(packets), _mean(events), "1")
            continue
        ratio = bootstrap((packets, eof), lambda a, b, axis=-1: a.mean(axis) / b.mean(axis), paired=True, rng=0)
        low, high = ratio.confidence_interval
        table.add_row(name, _mean(packets), _mean(events), f"{packets.mean() / eof.mean():.2f} [{low:.2f}, {high:.2f}]")
    return table


def _mean(values: np.ndarray) -> str:
    low, high = bootstrap((values,), np.mean, rng=0).confidence_interval
    return f"{values.mean():.0f} [{low:.0f}, {high:.0f}]"


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Outcome)))
