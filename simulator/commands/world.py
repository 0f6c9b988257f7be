"""``aicvds world``: a world's folder from flight plans, and flight plans from a world's folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, Positional, arg

from simulator.commands.running import command_main
from simulator.errors import UsageError


@dataclass(frozen=True)
class Import:
    """Make the UAVs' trajectories of a world from flight plans of QGroundControl.

    The waypoints of each plan become a UAV's trajectory, its geofence an area that no trajectory may leave (inclusion)
    or enter (exclusion). They go into FOLDER/world.geojson, where whatever is there stays, but for trajectories. A plan
    has no sensors, so add them to the file, as features of role sensor. What else a plan has is printed, such as
    take-off, landing, camera and speed items. Exit code: 0 done, 2 bad use or a plan that cannot be flown along
    straight legs.

    Two UAVs over the sensors that world.geojson in north/ already has:

      aicvds world import uav_0.plan uav_1.plan --out north
    """

    plans: Annotated[Positional[tuple[Path, ...]], arg(metavar="PLAN")]
    """Files of QGroundControl (.plan) or Mission Planner (.waypoints), one a UAV: the first is UAV 0's."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """The world's folder, made if missing. Required."""
    overwrite: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = False
    """Replace the trajectories that the world has."""


@dataclass(frozen=True)
class Export:
    """Write a world's trajectories as flight plans that QGroundControl opens and uploads.

    Each plan takes off, flies the trajectory at the world's altitude again and again, and has the world's fences.
    Look at it before you upload it. `aicvds fly` then flies it. Exit code: 0 done, 2 bad use.

      aicvds world export examples/pipeline_world --plan plans
    """

    world: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """The world's folder, with world.geojson."""
    plan: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder to write uav_0.plan, uav_1.plan and so on to, made if missing. Required."""
    overwrite: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = False
    """Overwrite earlier plans."""


USAGE = """usage: aicvds world import PLAN [PLAN ...] --out FOLDER
       aicvds world export FOLDER --plan DIR

`aicvds world import --help` and `aicvds world export --help` explain them."""


def main(argv: list[str]) -> int:
    """Run ``aicvds world``; returns the exit code."""
    if argv[:1] == ["import"]:
        return command_main(Import, "aicvds world import", argv[1:], import_world)
    if argv[:1] == ["export"]:
        return command_main(Export, "aicvds world export", argv[1:], export_world)
    print(USAGE)
    return 0 if argv[:1] in (["--help"], ["-h"]) else 2


def import_world(options: Import, console: Console) -> int:
    """Read the plans and write the world's features; returns the exit code.

    Raises:
        UsageError: the options, a plan or the world's file are unusable.
    """
    from simulator.sites.plans.plan_folder import import_plans

    if not options.plans:
        raise UsageError("PLAN is missing: name the .plan or .waypoints file of each UAV")
    if options.out is None:
        raise UsageError("--out is missing: name the world's folder, such as --out north")
    made = import_plans(options.plans, options.out, options.overwrite)
    print(f"Wrote {made.path}: {made.trajectories} trajectories, {made.fences} fences, {made.sensors} sensors.")
    for note in made.notes:
        print(note)
    if not made.sensors:
        print('Add the sensors before you fly it: Points with the properties "role": "sensor" and "id".')
    return 0


def export_world(options: Export, console: Console) -> int:
    """Write the plans; returns the exit code, raises ``UsageError`` for unusable options or worlds."""
    from simulator.sites.plans.plan_folder import export_plans

    if options.plan is None:
        raise UsageError("--plan is missing: name the folder for the plans, such as --plan plans")
    for path in export_plans(options.world, options.plan, options.overwrite):
        print(f"Wrote {path}")
    return 0
