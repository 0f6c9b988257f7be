"""``aicvds fly``: fly the missions of real UAVs over MAVLink, at the speeds that an edge decides."""

import asyncio
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, arg

from shared.wire.schemas import Mode
from simulator.commands.options import (
    check_between,
    check_deadline,
    check_mission,
    check_seed,
    check_wait,
    edge_from_option,
    site_from_options,
)
from simulator.commands.running import command_main
from simulator.errors import INTERRUPTED, UsageError
from simulator.records.run_folder import DECISIONS, refuse_old_result

if TYPE_CHECKING:
    from field.vehicles.field_flight import RealFlight
    from field.vehicles.field_run import FieldJob
    from simulator.sites.site import Site

# The longest default deadline of the edge. The UAV waits longer.
DEADLINE_MS = 3000
MOST_PATIENCE_S = 5.0


@dataclass(frozen=True)
class Fly:
    """Fly the missions of UAVs over MAVLink, at the speeds that an edge decides.

    Each UAV flies the mission that you uploaded to its autopilot, and this program sets its speed: at every waypoint of
    the world (each step_s seconds) it reads the position, hears the sensors' beacons, asks the edge which sensor to
    collect from and how fast to fly, and reports the outcome. At 0 m/s the UAV holds, then goes on with its
    mission. While the edge is silent the UAV collects from the longest queue in reach, at its last velocity.

    It never arms, takes off, lands or sends a position: the path is the uploaded mission, and failsafes are the
    autopilot's. A UAV that a pilot or a failsafe flies, or that is off its path or outside the world's fence, gets no
    command until it flies its mission again. Ctrl-C, SIGTERM and SIGHUP leave the UAVs on their missions.

    Write the plans of a world in the folder `line`, and upload each with QGroundControl:

      aicvds world export line --plan plans

    Arm, take off and start the missions. Then, from the ground, with a connection for each UAV:

      aicvds fly --mavlink udpin://0.0.0.0:14540 --world line --edge URL --mission line-1

    On board UAV 2 alone:

      aicvds fly --mavlink serial:///dev/ttyACM0:57600 --uav 2 --world line --edge URL --mission line-1

    Written to --out, as by `aicvds simulate`: summary.json, decisions.jsonl (one decision a line, written at once),
    report.html (open it in a browser) and requests.jsonl (for `aicvds replay`). The losses are those that the beacons
    reported. Ctrl-C, SIGTERM and SIGHUP still write the report. The environment variable AICVDS_API_KEY
    has the key for an edge that needs one. It needs the extra `mavlink`: pip install 'aic-vds[mavlink]'. Exit code: 0
    flown, 1 no vehicle, 2 bad use, 130 interrupted.
    """

    mavlink: Annotated[tuple[str, ...], arg(metavar="URL", help_behavior_hint="")] = ()
    """The MAVLink connection of each UAV, in the order of the world's trajectories: udpin://0.0.0.0:PORT to listen,
    udpout://HOST:PORT, tcpout://HOST:PORT or serial:///dev/NAME:BAUD. Required."""
    edge: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """The edge's address, such as http://127.0.0.1:8000. Required."""
    mission: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """The mission's ID at the edge. UAVs of one world that are flown by several commands share it. Required."""
    world: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """The world's folder, with world.geojson: the sensors, and a trajectory for each UAV, which its mission flies.
    Required."""
    uav: Annotated[int, arg(metavar="N")] = 0
    """The number of the first UAV among the world's trajectories."""
    radio: Annotated[str, arg(metavar="simulated|MODULE:NAME")] = "simulated"
    """The link to the ground sensors, which MAVLink does not have. simulated: sensors made up as `aicvds simulate`
    does, for trials. MODULE:NAME: your own, a callable that takes the site and returns a Radio
    (field/vehicles/radio.py; docs/guides/uav.md has an example)."""
    system_id: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """The MAVLink system ID of this program, 1 to 255. Default: each vehicle's own, as a computer on board has it."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the simulated sensors, 0 to 4294967295."""
    mode: Annotated[Mode | None, arg(metavar="guided|llm|value|policy", help_behavior_hint="")] = None
    """Who decides, in a mission that the edge does not have yet. Default: the edge's mode."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Waypoints to decide at, 1 to 10000. Default: the world's."""
    deadline_ms: Annotated[int | None, arg(metavar="MS", help_behavior_hint="")] = None
    """Milliseconds that the edge may take for one decision, 10 to 60000. Default: three fifths of --patience-s, 3000 at
    most."""
    patience_s: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """Seconds without an answer after which a UAV decides on board, less than a step. Default: 5, or half a step."""
    speedup: Annotated[float, arg(metavar="N")] = 1.0
    """How much faster than real time a simulated vehicle flies, 0.1 to 100, such as PX4_SIM_SPEED_FACTOR. 1 for real
    ones."""
    wait_s: Annotated[float, arg(metavar="S")] = 120.0
    """Seconds to wait for each vehicle, and for it to fly its mission."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder to write to, made if missing. Default: runs/, the mission's ID and the first UAV, such as
    runs/line-1-uav0."""
    overwrite: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = False
    """Overwrite an earlier flight's log."""


def main(argv: list[str]) -> int:
    """Run ``aicvds fly``; returns the exit code."""
    command = shlex.join(["aicvds", "fly", *argv])
    return command_main(Fly, "aicvds fly", argv, lambda options, console: fly(options, command, console))


def fly(options: Fly, command: str, console: Console) -> int:
    """Fly, write, print; returns the exit code.

    Raises:
        UsageError: the options, the world, a vehicle's mission or the folder are unusable.
        VehicleError: a vehicle is not heard, or does not fly its mission.
    """
    job = job_from_options(options)
    from field.vehicles.field_run import FlightInterrupted, run_field_mission

    code = 0
    flown: RealFlight | None
    try:
        flown = asyncio.run(run_field_mission(job))
    except FlightInterrupted as cut:
        flown, code = cut.flight, INTERRUPTED
        console.print("interrupted; the UAVs are on their missions", highlight=False)
    if flown is not None:
        conclude(flown, job, command, console)
    return code


def job_from_options(options: Fly) -> "FieldJob":
    """The flight that the options describe; raises ``UsageError`` for the first that is unusable."""
    mission_id = check(options)
    edge = edge_from_option(options.edge)
    out = options.out or Path("runs") / f"{mission_id}-uav{options.uav}"
    refuse_old_result(out, options.overwrite, DECISIONS)
    from field.vehicles.mavlink_vehicle import require_mavsdk

    require_mavsdk()
    site = checked_site(options)
    from field.vehicles.field_run import FieldJob
    from field.vehicles.radio import SIMULATED, radio_named

    step_s = site.scenario.step_s / options.speedup
    patience_s = min(MOST_PATIENCE_S, step_s / 2) if options.patience_s is None else options.patience_s
    check_between("--patience-s", patience_s, 0.05, step_s)
    # The edge gives its best answer in time only if it knows how long the UAV waits for it.
    in_time_ms = max(10, min(DEADLINE_MS, int(600 * patience_s)))
    return FieldJob(
        site=site,
        radio=radio_named(options.radio, site, options.seed),
        first_uav=options.uav,
        edge=edge,
        mission_id=mission_id,
        out=out,
        seed=options.seed if options.radio == SIMULATED else None,
        deadline_ms=in_time_ms if options.deadline_ms is None else options.deadline_ms,
        patience_s=patience_s,
        **{name: getattr(options, name) for name in ("mavlink", "mode", "speedup", "wait_s", "system_id")},
    )


def check(options: Fly) -> str:
    """The mission's ID; raises ``UsageError`` for the first option that is missing or out of bounds."""
    if not options.mavlink:
        raise UsageError("--mavlink is missing: give each UAV's connection, such as --mavlink udpin://0.0.0.0:14540")
    if options.mission is None:
        raise UsageError("--mission is missing: give the mission's ID at the edge, such as --mission line-1")
    check_mission(options.mission)
    if options.world is None:
        raise UsageError(
            "--world is missing: give the folder with world.geojson, such as --world examples/pipeline_world"
        )
    check_seed(options.seed)
    check_wait(options.wait_s)
    check_deadline(options.deadline_ms)
    check_between("--speedup", options.speedup, 0.1, 100.0)
    if options.system_id is not None:
        check_between("--system-id", options.system_id, 1, 255)
    places = [listened_at(url) for url in options.mavlink]
    for place, url in zip(places, options.mavlink, strict=True):
        if places.count(place) > 1:
            raise UsageError(
                f"--mavlink {url}: two connections to one place ({place}) would hear the same vehicle twice; let each "
                "vehicle send to a port of its own, such as 14540 and 14541"
            )
    return options.mission


def listened_at(url: str) -> str:
    """The port or device of a connection: two that listen on one UDP port hear the same vehicles, whatever the host."""
    scheme, _, place = url.partition("://")
    return f"UDP port {place.rpartition(':')[2]}" if scheme in ("udp", "udpin") else url


def checked_site(options: Fly) -> "Site":
    """The world; raises ``UsageError`` if it is unusable or has no trajectory for one of the UAVs."""
    site = site_from_options(None, options.world, options.steps)
    last = site.scenario.uavs - len(options.mavlink)
    trajectories = f"the world has {site.scenario.uavs} trajectories"
    if last < 0:
        raise UsageError(f"--mavlink: {len(options.mavlink)} connections, but {trajectories}; leave some out")
    if not 0 <= options.uav <= last:
        raise UsageError(
            f"--uav {options.uav}: {trajectories} and --mavlink names {len(options.mavlink)}; choose 0 to {last}"
        )
    return site


def conclude(flown: "RealFlight", job: "FieldJob", command: str, console: Console) -> None:
    """Write a flight's summary and report, and print its outcome; raises ``UsageError``: the folder is unusable."""
    from field.vehicles.radio import SimulatedRadio
    from simulator.records.real_uavs import RealUavs, sums_by_uav
    from simulator.records.summary import summarise
    from simulator.reporting.results import write_results

    facts = flown.facts(
        policy="edge",
        edge=job.edge,
        uplink="full",
        mission_id=job.mission_id,
        mode=flown.mode,
        model=None,
        deadline_ms=job.deadline_ms,
        command=command,
    ).model_copy(update={"seed": job.seed, "uavs": len(job.mavlink)})
    tallies = {"aic_vds": flown.tally}
    real = RealUavs(
        uavs=sums_by_uav(flown.decisions, flown.metres),
        late=flown.late,
        undecided=dict(flown.undecided.most_common()),
        not_carried_out=flown.not_carried_out,
        ended=flown.ended,
        warnings=flown.warnings,
        simulated_lost=job.radio.lost if isinstance(job.radio, SimulatedRadio) else None,
    )
    summary = summarise(facts, flown.decisions, tallies).model_copy(update={"real_uavs": real, "names": job.site.names})
    write_results(job.out, summary, flown, tallies, console)
