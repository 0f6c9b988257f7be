"""The folder of a user's own world: sensors, trajectories, scenario fields and recorded arrivals in files.

docs/guides/own-world.md specifies the files ``world.geojson``, ``scenario.toml``, ``arrivals.csv`` and ``gains.csv``.
A seed draws each UAV's start along its trajectory, the initial queues and, without a trace, the arrivals.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from shared.world.channel import FloatArray, link_holds
from shared.world.scenario import Point, Scenario
from shared.world.trajectory import trajectories
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.names_and_map import chained, names_and_map, simplified
from simulator.sites.files.overrides import read_overrides
from simulator.sites.files.reading import quoted
from simulator.sites.files.recordings import read_gains, read_trace
from simulator.sites.files.survey import MAX_WAYPOINTS, Survey, check_complete, read_survey
from simulator.sites.projection import Frame, centre_of, fit_square
from simulator.sites.site import Site

__all__ = ["ARRIVALS", "FEATURES", "GAINS", "OVERRIDES", "site_from_folder"]

FEATURES, OVERRIDES, ARRIVALS, GAINS = "world.geojson", "scenario.toml", "arrivals.csv", "gains.csv"
MAX_AREA_M = 1_000_000.0
# Parts of a pipeline that are nearer than this meet. Beyond this latitude an edge may mean either way around a pole.
_GAP_M, _POLAR = 1.0, 70.0
# The most sensors out of reach that a warning names.
FAR_NAMED = 5


def site_from_folder(
    folder: Path, steps: int | None = None, on_warning: Callable[[str], None] = lambda text: None
) -> Site:
    """The site that a world's folder describes.

    Args:
        folder: its name is the scenario's, unless ``scenario.toml`` sets ``name``.
        steps: of a mission, from 1 to 10,000; overrides the scenario's.
        on_warning: called with a warning about sensors that no UAV can reach.

    Raises:
        UsageError: a file is missing or invalid; the text names the file, and the line or the feature.
    """
    if not folder.is_dir():
        raise UsageError(f"--world {folder} is no folder; name one that contains {FEATURES}")
    return site_of(read_survey(folder / FEATURES), folder, steps, on_warning)


def site_of(
    survey: Survey, folder: Path, steps: int | None = None, on_warning: Callable[[str], None] = lambda text: None
) -> Site:
    """The site of the features that are, or are to be, in a folder, and of its other files; as above."""
    check_complete(folder / FEATURES, survey)
    overrides = read_overrides(folder / OVERRIDES)
    placed, frame, fences = placed_features(survey, folder / FEATURES, on_warning)
    derived = placed | ({} if steps is None else {"steps": steps})
    if "name" not in overrides.values:
        derived["name"] = _fit_name(folder.resolve().name)
    scenario = overrides.scenario(derived)
    names, gains = list(survey.sensors), folder / GAINS
    lengths_m = [path.length_m for path in trajectories(scenario)]
    arrivals = _arrivals(folder / ARRIVALS, scenario, names)
    links = read_gains(gains, names, lengths_m) if gains.exists() else None
    mapped = names_and_map(survey, folder / FEATURES, frame, fences)
    site = Site(scenario, arrivals, links, frame, tuple(names), fences, *mapped)
    far = [name for name, near in zip(survey.sensors, _reachable(scenario), strict=True) if not near]
    if far:
        named = ", ".join(quoted(name) for name in far[:FAR_NAMED]) + (" and others" if len(far) > FAR_NAMED else "")
        on_warning(
            f"{folder / FEATURES}: {len(far)} of {scenario.sensors} sensors can be reached from no trajectory "
            f"({named}); their packets will be lost"
        )
    return site


def placed_features(
    survey: Survey, path: Path, on_warning: Callable[[str], None] = lambda text: None
) -> tuple[dict[str, object], Frame, tuple[Fence, ...]]:
    """The fields of a scenario that follow from the features, its plane's place on the globe, and the fences in it.

    Raises:
        UsageError: the features are too far apart, or a trajectory breaks a fence.
    """
    drawn = [*survey.trajectories.values(), *survey.pipeline]
    degrees = [*survey.sensors.values(), *(point for line in drawn for point in line)]
    plane = Frame(*centre_of(degrees), (0.0, 0.0))
    _check_extent(path, plane.metres(degrees))
    lines = [np.array(list(survey.sensors.values())).reshape(-1, 2), *map(plane.bent, drawn)]
    # To the millimetre, which is the same to the bit with another version of the projection's library.
    projected = np.round(plane.metres(np.concatenate(lines)), 3)
    _check_extent(path, projected)
    metres, side = fit_square(projected)
    x, y = (metres[0] - projected[0]).tolist()
    frame = Frame(plane.longitude, plane.latitude, (x, y))
    sites, *parts = np.split(metres, np.cumsum([len(line) for line in lines])[:-1])
    routes = [_points(part) for part in parts[: len(survey.trajectories)]]
    for label, route in zip(survey.trajectories, routes, strict=True):
        if len(set(route)) < 2:
            raise UsageError(f"{path}, {label}: all waypoints are the same; a trajectory needs two that differ")
        if len(route) > MAX_WAYPOINTS:
            raise UsageError(
                f"{path}, {label}: its long legs, straight in degrees, are {len(route):,} waypoints in metres, at most "
                f"{MAX_WAYPOINTS:,}; shorten them"
            )
    pipeline, gap_m = chained(parts[len(routes) :])
    if gap_m > _GAP_M:
        on_warning(f"{path}: the pipeline's parts are up to {gap_m:,.0f} m apart; pictures show them joined")
    return {
        "layout": "surveyed",
        "sensors": len(sites),
        "uavs": len(routes),
        "area_m": side,
        "sites": _points(sites),
        "routes": tuple(routes),
        "pipeline": _points(simplified(pipeline, MAX_WAYPOINTS)),
    }, frame, _fences(survey, path, frame, routes)  # fmt: skip


def _check_extent(path: Path, metres: FloatArray) -> None:
    across = float(np.ptp(metres, axis=0).max()) if np.isfinite(metres).all() else np.inf
    if across > MAX_AREA_M:
        how_far = f"{across / 1000:,.0f} km across" if np.isfinite(across) else "spread around the Earth"
        raise UsageError(
            f"{path}: the features are {how_far}, at most {MAX_AREA_M / 1000:,.0f} km fit; look for a swapped or "
            f"mistyped coordinate"
        )


def _fences(survey: Survey, path: Path, frame: Frame, routes: Sequence[Sequence[Point]]) -> tuple[Fence, ...]:
    """The fences in the scenario's plane; raises ``UsageError`` for a trajectory that breaks one."""
    fences = []
    for label, drawn in survey.fences.items():
        corners = frame.metres(drawn.points) - frame.centre
        # Not a number, or infinite, on the other side of the Earth.
        if not np.linalg.norm(corners, axis=1).max() <= 2 * MAX_AREA_M:
            raise UsageError(f"{path}, {label}: the fence is more than {MAX_AREA_M / 500:,.0f} km away; draw it nearer")
        apart = np.abs(np.diff(np.array(drawn.points), axis=0))[:, 0]
        polar = np.abs([latitude for _, latitude in drawn.points[1:]]) > _POLAR
        if (apart > np.where(polar, 180.0, 359.999999)).any():
            raise UsageError(f"{path}, {label}: an edge goes around the Earth; give it corners that are nearer")
        fence = Fence(drawn.role, _points(frame.metres(frame.bent(drawn.points))), drawn.radius, drawn.name)
        for of, route in zip(survey.trajectories, routes, strict=True):
            broken = fence.first_breach(route)
            if broken is not None:
                does = "leaves the fence" if fence.role == "fence" else "enters the no_fly area"
                raise UsageError(f"{path}, {of}: it {does} {label} at waypoint {broken}; move the one or the other")
        fences.append(fence)
    return tuple(fences)


def _reachable(scenario: Scenario) -> Iterator[bool]:
    """For each sensor, whether some trajectory comes into its radio range."""
    paths = [(path, *path.bounds) for path in trajectories(scenario)]
    for sensor in scenario.sites:
        yield any(
            # The bounding boxes exclude most trajectories of a large world without a look at their legs.
            np.all((low - scenario.radio_radius_m <= sensor) & (sensor <= high + scenario.radio_radius_m))
            and link_holds(path.locate(sensor)[1], scenario)
            for path, low, high in paths
        )


def _points(metres: FloatArray) -> tuple[Point, ...]:
    return tuple((x, y) for x, y in metres.tolist())


def _fit_name(folder: str) -> str:
    """A folder's name as a scenario's name: at most 32 lower-case letters, digits and underscores, a letter first."""
    name = re.sub(r"[^a-z0-9]+", "_", folder.lower()).strip("_")
    return (name if re.match("[a-z]", name) else f"world_{name}".rstrip("_"))[:32]


def _arrivals(path: Path, scenario: Scenario, sensors: list[str]) -> np.ndarray | None:
    if not path.exists():
        return None
    trace = read_trace(path, sensors)
    if len(trace) < scenario.steps:
        raise UsageError(
            f"{path} has {len(trace)} steps, the mission {scenario.steps}; add lines, or fly fewer steps "
            f"(--steps {len(trace)})"
        )
    return trace
