"""The growth of trust in a good LLM within one mission: no planner, and an LLM that answers as the planner would.

    python -m lab.benchmarks.trust --seeds 30

It flies every world twice over HTTP: by the edge's planner (mode `policy`), and in mode `guided` without the planner
and with an LLM that names the planner's action, if that is a candidate. It prints the losses of both with
95% bootstrap intervals over worlds, their ratio, and the LLM's weight among the advisers in the course of a mission; it
writes the same as JSON. Goal: at most 1.10 times the planner's losses. One world takes some ten seconds.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import tyro
import uvicorn
from rich.console import Console
from rich.progress import track

from lab.experiments.intervals import interval, paired
from service.api.app import create_app
from service.config.settings import Settings
from service.deciding.deliberation import LlmAdvice
from service.deciding.stopwatch import Deadline
from service.edge.engine import Engine
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet
from service.prompting.prompt import Prompt
from shared.client.edge_client import EdgeClient
from shared.wire.schemas import Mode
from shared.world.scenario import Scenario, scenario_named
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot, PilotChoice
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.sites.site import Site
from simulator.world.observation import Observation

GOAL = 1.10
# The probability of all other letters together.
_DOUBT = 0.05


@dataclass(frozen=True)
class Trusted:
    """Fly worlds by the planner, and by an LLM that answers as the planner would."""

    seeds: int = 30
    """Worlds: seeds --first to --first + N - 1."""
    first: int = 0
    """The first seed."""
    scenario: str = "paper"
    """Scenario of the worlds."""
    out: Path = Path("runs/trust.json")
    """Where to write the figures."""


class Echo:
    """A stand-in for the LLM that advises ``answer``, or the candidate nearest to it."""

    def __init__(self) -> None:
        self.answer: tuple[int, int] = (0, 0)

    async def ask(self, mission: Mission, offer: CandidateSet, prompt: Prompt, deadline: Deadline) -> LlmAdvice:
        """Advise the answer's sensor at the nearest velocity, or else the first letter, with nearly all probability."""
        sensor, velocity = self.answer
        letters = list(offer.labels)
        of_sensor = [letter for letter in letters if offer.actions[offer.labels[letter]][0] == sensor] or letters[:1]
        nearest = min(of_sensor, key=lambda letter: abs(offer.actions[offer.labels[letter]][1] - velocity))
        probabilities = {letter: _DOUBT / len(letters) + (1.0 - _DOUBT) * (letter == nearest) for letter in letters}
        return LlmAdvice(prompt, offer.by_action(probabilities), None, None, calibrated=False, model=None)


class Pilot(EdgePilot):
    """Gives the edge's reports to a planner of its own, and the planner's action to the LLM before the edge asks."""

    def __init__(self, client: EdgeClient, scenario: Scenario, seed: int, echo: Echo) -> None:
        super().__init__(client, f"echo-{seed}", scenario, seed)
        self.planner = RecedingHorizonPolicy()
        self.planner.reset(scenario, seed)
        self._echo = echo
        self.trust: list[float] = []

    def decide(self, uav: int, observation: Observation, taken: frozenset[int]) -> PilotChoice:
        """The edge's choice."""
        self._echo.answer = self.planner.decide(uav, observation, taken)
        choice = super().decide(uav, observation, taken)
        self.planner.belief.record_decision(uav, int(observation["step"][0]), choice.sensor, choice.velocity)
        guided = None if choice.exchange is None else choice.exchange.response.guided
        if guided is not None:
            self.trust.append(guided.trust["llm"])
        return choice


@contextmanager
def edge() -> Iterator[tuple[str, Engine]]:
    """A real edge on a free loopback port, without an LLM: its base URL and its engine."""
    app = create_app(Settings(mode="policy"))
    server = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}", app.state.engine
    finally:
        server.should_exit = True
        thread.join()


def flown(url: str, site: Site, seed: int, echo: Echo, mode: Mode) -> tuple[int, list[float]]:
    """Packets lost in one world, and the LLM's weight at each decision."""
    with EdgeClient(url, timeout_s=60.0) as client:
        pilot = Pilot(client, site.scenario, seed, echo) if mode == "guided" else None
        flying = pilot or EdgePilot(client, f"planner-{seed}", site.scenario, seed)
        flying.spec = flying.spec.model_copy(update={"mode": mode, "planner": "off" if pilot else "on"})
        client.put_mission(f"{'echo' if pilot else 'planner'}-{seed}", flying.spec)
        flight = fly(site, flying, seed)
    return sum(tally.lost_packets for tally in flight.tally), pilot.trust if pilot else []


def main(args: Trusted) -> int:
    """Fly, print, write."""
    console = Console()
    site = Site(scenario_named(args.scenario))
    seeds = range(args.first, args.first + args.seeds)
    lost: dict[str, list[int]] = {"planner": [], "echo": []}
    trust: list[list[float]] = []
    with edge() as (url, engine):
        echo = Echo()
        # The stand-in replaces the method that queries an LLM about one UAV.
        setattr(engine.queries, "ask", echo.ask)  # noqa: B010
        for seed in track(seeds, "Flying", console=console):
            lost["planner"].append(flown(url, site, seed, echo, "policy")[0])
            total, weights = flown(url, site, seed, echo, "guided")
            lost["echo"].append(total)
            trust.append(weights)
    compared = paired("echo", "planner", "lost_packets", lost["echo"], lost["planner"])
    steps = [1, 10, 30, 60, min(map(len, trust))]
    at = {str(n): sum(weights[n - 1] for weights in trust) / len(trust) for n in steps}
    for name, packets in lost.items():
        found = interval(packets)
        console.print(f"{name}: {found.mean:.1f} [{found.low:.1f}, {found.high:.1f}] packets lost a mission")
    for pair in compared:
        console.print(f"{pair.kind}: {pair.mean:.2f} [{pair.low:.2f}, {pair.high:.2f}]")
    console.print("the LLM's weight at decision " + ", ".join(f"{n}: {weight:.2f}" for n, weight in at.items()))
    found_all = {
        "scenario": args.scenario,
        "seeds": list(seeds),
        "lost_packets": lost,
        "compared": [pair.model_dump() for pair in compared],
        "trust_at_decision": at,
        "goal": GOAL,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found_all, indent=2) + "\n")
    console.print(f"Wrote {args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Trusted, description=__doc__)))
