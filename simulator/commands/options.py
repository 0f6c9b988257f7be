"""Checks of the options that several commands share."""

import sys
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from shared.client.retries_and_redirects import edge_url
from shared.wire.schemas import MissionId, Note
from shared.world.scenario import Scenario, scenario_named
from simulator.errors import UsageError
from simulator.sites.site import Site


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


def site_from_options(scenario: str | None, world: Path | None, steps: int | None = None) -> Site:
    """The site that a command's options name; by default the scenario ``paper``.

    Warnings about a world, such as a sensor out of every UAV's reach, go to stderr.

    Args:
        scenario: ``--scenario``, a preset's name.
        world: ``--world``, a folder as :mod:`simulator.sites.files.world_folder` describes it.
        steps: ``--steps``; overrides the number of steps of the scenario or the world.

    Raises:
        UsageError: both a scenario and a world are given, an option is out of bounds, or a world's file is missing or
            invalid.
    """
    if world is None:
        return Site(scenario_from_options(scenario or "paper", steps))
    if scenario is not None:
        raise UsageError(f"--scenario {scenario[:32]} and --world {world} contradict each other; give one of the two")
    if steps is not None and not 1 <= steps <= 10_000:
        raise UsageError(f"--steps {steps} is not between 1 and 10000")
    # Reading a world folder imports pyproj, a tenth of a second that `--help` and presets do not need.
    from simulator.sites.files.world_folder import site_from_folder

    return site_from_folder(world, steps, on_warning=lambda text: print(f"warning: {text}", file=sys.stderr))


def scenario_from_options(name: str, steps: int | None = None) -> Scenario:
    """The preset of that name, with ``steps`` overridden if given; raises ``UsageError``."""
    try:
        scenario = scenario_named(name)
        return scenario if steps is None else Scenario.model_validate({**scenario.model_dump(), "steps": steps})
    except ValueError as error:
        known = not str(error).startswith("unknown scenario")
        raise UsageError(f"--steps {steps} is not between 1 and 10000" if known else f"--scenario: {error}") from None
