"""The options that several commands share, and checks of them."""

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import TypeAdapter, ValidationError
from tyro.conf import UseAppendAction, arg

from shared.client.retries_and_redirects import edge_url
from shared.kit.validation_messages import problem_of, suggestion
from shared.wire.schemas import MissionId, Note
from shared.world.scenario import Scenario, scenario_named
from simulator.errors import UsageError
from simulator.sites.site import Site


@dataclass(frozen=True)
class WorldOptions:
    """The options that name a world, as :func:`site_of` reads them."""

    scenario: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """A ready-made world: paper (10 sensors, 3 UAVs, 30 steps; the default), paper_light (a tenth of its arrivals, full
    queues), pipeline (sensors in a line), stress (weak link), dense (100 sensors, 10 UAVs) or lossy_uplink (a tenth of
    the requests lost). In the other six the world differs from the edge's model: shadowed (links 8 dB off), fading,
    bursty (arrivals), windy, faulty (dead radios, a UAV gone, half of the rate lost) and field (all of it, mild)."""
    world: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """A world of your own, instead of --scenario: a folder with world.geojson (sensors, trajectories) and, optionally,
    scenario.toml (other numbers), arrivals.csv (recorded traffic) and gains.csv (recorded links).
    examples/pipeline_world is one."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of the world, 0 to 4294967295: it draws the sensors, queues, arrivals and starts that are not given. The
    same seed gives the same world."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Waypoints to fly, 1 to 10000, but no more than a mission that is at the edge has. Default: the world's (30 in
    every scenario)."""
    sensors: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Sensors in the scenario, 1 to 2000. Default: the scenario's."""
    uavs: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """UAVs in the scenario, 1 to 100. Default: the scenario's."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="FIELD=VALUE")] = ()
    """Another value for a field of the scenario, such as wind_mps=4 or link_share=0.5; repeatable. The fields are those
    of shared/world/scenario.py. A changed scenario is named NAME_changed and a number, unless name=... names it."""


def site_of(options: WorldOptions) -> Site:
    """The site that a command's options name, as :func:`site_from_options`."""
    changes = changes_of(options.set, options.sensors, options.uavs)
    check_seed(options.seed)
    return site_from_options(options.scenario, options.world, options.steps, changes)


def changes_of(given: Sequence[str], sensors: int | None, uavs: int | None) -> dict[str, Any]:
    """A scenario's fields of ``--set FIELD=VALUE``, ``--sensors`` and ``--uavs``; raises ``UsageError``."""
    changes: dict[str, Any] = {}
    for one in given:
        field, equals, value = one.partition("=")
        if not equals:
            raise UsageError(f"--set {one[:64]}: write FIELD=VALUE, such as wind_mps=4")
        if field not in Scenario.model_fields:
            near = suggestion(field, Scenario.model_fields)
            raise UsageError(f"--set {one[:64]}: a scenario has no field {field[:32]!r}{near}")
        try:
            changes[field] = json.loads(value)
        except (ValueError, RecursionError):
            changes[field] = value
    return changes | {name: n for name, n in (("sensors", sensors), ("uavs", uavs)) if n is not None}


def check_between(option: str, value: float, least: float, most: float) -> None:
    """Raises ``UsageError`` for an option such as ``--port`` whose value is not from ``least`` to ``most``."""
    if not least <= value <= most:
        shown = f"{value:g}" if isinstance(value, float) else value
        raise UsageError(f"{option} {shown} is not between {least} and {most}")


def check_seed(seed: int) -> None:
    """Raises ``UsageError`` for a ``--seed`` out of bounds."""
    check_between("--seed", seed, 0, 2**32 - 1)


def check_wait(wait_s: float) -> None:
    """Raises ``UsageError`` for a ``--wait-s`` that is negative or more than a day."""
    check_between("--wait-s", wait_s, 0, 86_400)


def check_deadline(deadline_ms: int | None) -> None:
    """Raises ``UsageError`` for a ``--deadline-ms`` out of the edge's bounds; ``None`` selects the edge's default."""
    if deadline_ms is not None:
        check_between("--deadline-ms", deadline_ms, 10, 60_000)


def check_mission(mission_id: str | None) -> None:
    """Raises ``UsageError`` for a ``--mission`` that is no mission's ID."""
    if mission_id is not None:
        _check_as(
            MissionId, "--mission", mission_id, "use letters, digits, . _ and -, at most 64, a letter or digit first"
        )


def check_note(note: str | None) -> None:
    """Raises ``UsageError`` for a ``--note`` that is too long or has line breaks."""
    if note is not None:
        _check_as(Note, "--note", note, "give one paragraph of at most 280 printable characters")


def _check_as(kind: Any, option: str, value: str, remedy: str) -> None:
    try:
        TypeAdapter(kind).validate_python(value)
    except ValidationError:
        raise UsageError(f"{option} {value[:32]!r}: {remedy}") from None


def edge_from_option(edge: str | None) -> str:
    """The URL in ``--edge``; raises ``UsageError`` for a missing or invalid one."""
    if edge is None:
        raise UsageError("--edge is missing: give the edge's address, such as --edge http://127.0.0.1:8000")
    try:
        return edge_url(edge)
    except ValueError as error:
        raise UsageError(f"--edge: {error}") from None


def site_from_options(
    scenario: str | None, world: Path | None, steps: int | None = None, changes: Mapping[str, Any] | None = None
) -> Site:
    """The site that a command's options name; by default the scenario ``paper``.

    Warnings about a world, such as a sensor out of every UAV's reach, go to stderr.

    Args:
        scenario: ``--scenario``, a preset's name.
        world: ``--world``, a folder as :mod:`simulator.sites.files.world_folder` describes it.
        steps: ``--steps``; overrides the number of steps of the scenario or the world.
        changes: other values of a scenario's fields, by name.

    Raises:
        UsageError: both a scenario and a world are given, an option is out of bounds, or a world's file is missing or
            invalid.
    """
    if world is None:
        return Site(scenario_from_options(scenario or "paper", steps, changes))
    if scenario is not None:
        raise UsageError(f"--scenario {scenario[:32]} and --world {world} contradict each other; give one of the two")
    if changes:
        raise UsageError(f"--world {world}: its files have the value of {', '.join(changes)}; change it there")
    _check_steps(steps)
    # Reading a world folder imports pyproj, a tenth of a second that `--help` and presets do not need.
    from simulator.sites.files.world_folder import site_from_folder

    return site_from_folder(world, steps, on_warning=lambda text: print(f"warning: {text}", file=sys.stderr))


def scenario_from_options(name: str, steps: int | None = None, changes: Mapping[str, Any] | None = None) -> Scenario:
    """The preset of that name, with ``steps`` and ``changes`` in place of its values.

    Raises:
        UsageError: there is no such preset, or a value is out of bounds or contradicts another.
    """
    try:
        scenario = scenario_named(name)
    except ValueError as error:
        raise UsageError(f"--scenario: {error}") from None
    _check_steps(steps)
    # Other changes have another name, so that a comparison notices.
    digest = hashlib.blake2b(repr(sorted((changes or {}).items())).encode(), digest_size=2).hexdigest()
    values = {**({"name": f"{name}_changed_{digest}"} if changes else {}), **(changes or {})}
    values |= {} if steps is None else {"steps": steps}
    try:
        return Scenario.model_validate({**scenario.model_dump(), **values}) if values else scenario
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = str(first["loc"][0]) if first["loc"] else ""
        given = f"{field}={json.dumps(values[field])[:64]}" if field else ""
        option = f"--{field} {values[field]}" if field in ("sensors", "uavs") else f"--set {given}".rstrip()
        raise UsageError(f"{option}: {problem_of(first)}") from None


def _check_steps(steps: int | None) -> None:
    if steps is not None:
        check_between("--steps", steps, 1, 10_000)
