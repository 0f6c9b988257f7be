"""``aicvds mission``: make a mission at an edge for a world, and print a request that works for it."""

import json
import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import arg

from shared.client.edge_client import API_KEY
from shared.wire.schemas import DecideRequest, MissionSpec, Mode
from simulator.commands.options import check_mission, check_note, check_seed, edge_from_option, site_from_options
from simulator.commands.running import command_main
from simulator.flying.job import new_mission_id

_HEADER = ' -H "Authorization: Bearer $AICVDS_API_KEY"'


@dataclass(frozen=True)
class Create:
    """Make a mission at an edge for your world, and print a /decide request for its sensors that works as pasted.

    The edge learns the world: its sensors, trajectories and numbers. The request printed is UAV 0's at step 0; put what
    your UAV knows in place of its queues, batteries, gains and steps. The environment variable AICVDS_API_KEY has a
    key of scope admin for an edge that needs one. Exit code: 0 done, 1 no edge, 2 bad use.

    Try it:  aicvds mission create --edge http://127.0.0.1:8000 --world examples/pipeline_world
    """

    edge: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """The edge's address, such as http://127.0.0.1:8000. Required."""
    world: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """A folder with world.geojson and, optionally, scenario.toml and arrivals.csv, as examples/pipeline_world."""
    scenario: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """A ready-made world instead: paper (the default) or one of those in `aicvds simulate --help`."""
    mission: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """The mission's ID. Default: a new one, such as pipeline_world-0-1f6c09ab."""
    mode: Annotated[Mode | None, arg(metavar="guided|llm|value|policy", help_behavior_hint="")] = None
    """Who decides. Default: the edge's mode."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Waypoints of the mission, 1 to 10000. Default: the world's (30 in every scenario)."""
    note: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="")] = None
    """The operator's note in plain words. The edge obeys it once it is confirmed."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the values in the printed request."""


def main(argv: list[str]) -> int:
    """Run ``aicvds mission``; returns the exit code."""
    if argv[:1] != ["create"]:
        print("usage: aicvds mission create --edge URL [--world FOLDER]\n\n`aicvds mission create --help` explains it.")
        return 0 if argv[:1] in (["--help"], ["-h"]) else 2
    return command_main(Create, "aicvds mission create", argv[1:], create)


def create(options: Create, console: Console) -> int:
    """Make the mission and print what to paste; returns the exit code.

    Raises:
        UsageError: the options or the world's files are unusable.
        EdgeError: the edge cannot be reached, or refuses.
    """
    edge = edge_from_option(options.edge)
    check_seed(options.seed)
    check_mission(options.mission)
    check_note(options.note)
    site = site_from_options(options.scenario, options.world, options.steps)
    from shared.client.edge_client import EdgeClient
    from simulator.world.observation import decide_request

    mission_id = options.mission or new_mission_id(site.scenario, options.seed)
    spec = site.named(MissionSpec(scenario=site.scenario, mode=options.mode, seed=options.seed, note=options.note))
    key = os.environ.get(API_KEY) or None
    with EdgeClient(edge, api_key=key) as client:
        made = client.put_mission(mission_id, spec)
    observations, _ = site.world().reset(seed=options.seed)
    request = decide_request(0, observations["uav_0"], mission_id)
    world = site.scenario
    fleet = "1 UAV" if world.uavs == 1 else f"{world.uavs} UAVs"
    print(f"# Mission {mission_id}: {world.sensors} sensors, {fleet}, {world.steps} steps, mode {made.mode}.")
    print(f"# Watch it at {edge}/?mission={mission_id}")
    print("# Ask for a decision:")
    print(curl(f"{edge}/decide", readable_json(request), key is not None))
    print("# Report its outcome, with the decision_id of the answer. The cost is 1 if the transmission failed, and for")
    print("# every sensor the packets that it lost in the step, divided by its queue's capacity:")
    print(curl(f"{edge}/feedback", '{"decision_id": "…", "cost": 0.2}', key is not None))
    if options.note is not None:
        guidance = f"{edge}/missions/{mission_id}/guidance"
        print("# How the LLM compiled the note, after a few seconds, and your confirmation:")
        print(f"curl {shlex.quote(guidance)}{_HEADER if key is not None else ''}")
        print(curl(guidance, '{"answer": "confirm"}', key is not None))
    return 0


def curl(url: str, body: str, with_key: bool) -> str:
    """A command that posts the body, to be pasted into a shell."""
    key = _HEADER if with_key else ""
    return f"curl -X POST {shlex.quote(url)} -H 'Content-Type: application/json'{key} -d {shlex.quote(body)}"


def readable_json(request: DecideRequest) -> str:
    """The request's JSON, a line for each column, with numbers that people can read."""
    body: dict[str, Any] = json.loads(request.model_dump_json(exclude_none=True, exclude={"sensors"}))
    columns = {name: _rounded(column) for name, column in request.sensors.model_dump().items()}
    rows = ",\n".join(f'    "{name}": {json.dumps(column)}' for name, column in columns.items())
    head = ",\n".join(f'  "{name}": {json.dumps(_rounded(value))}' for name, value in body.items())
    return f'{{\n{head},\n  "sensors": {{\n{rows}}}}}'


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return round(value, 1) if isinstance(value, float) else value
