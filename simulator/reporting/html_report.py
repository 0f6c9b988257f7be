"""``report.html``: a page about one mission that needs no other file."""

import base64
import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from shared.wire.names import Names, with_names
from shared.world.scenario import Scenario
from shared.world.trajectory import trajectories
from simulator.records.decision import Decision
from simulator.records.run_folder import FIGURES
from simulator.records.summary import Summary
from simulator.records.track import Instant, Track
from simulator.reporting import figures
from simulator.reporting.figure_style import PaperFigure
from simulator.reporting.wording import (
    ADVISERS,
    bound_text,
    late_text,
    llm_notice,
    number,
    orders_text,
    percent,
    policy_labels,
    verdict,
    world_text,
)
from simulator.world.observation import StepTally

# Points of all the drawn trajectories; one circle has at most 121.
_POINTS, _POINTS_EACH = 3_000, 121


@dataclass(frozen=True)
class Playback:
    """What the page embeds: the mission as JSON's types, and the script that shows every ``stride``-th step of it."""

    mission: dict[str, Any]
    stride: int
    script: str

    @property
    def script_source(self) -> str:
        """The script's source expression for a Content-Security-Policy."""
        digest = hashlib.sha256(self.script.encode("utf-8")).digest()
        return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def playback(
    scenario: Scenario, sensor_xy: np.ndarray, decisions: Iterable[Decision], instants: Sequence[Instant], stride: int
) -> Playback | None:
    """The playback of a mission; ``None`` where no step was flown.

    Args:
        scenario: of the mission, for the map, the queues' capacity and the batteries.
        sensor_xy: (J, 2), metres.
        decisions: of the steps flown.
        instants: every ``stride``-th of the mission and the last, the start first.
        stride: 1 where no instant is left out.
    """
    if len(instants) < 2:
        return None
    shown = {instant.step for instant in instants}
    by_step: dict[int, list[list[Any]]] = defaultdict(list)
    for d in decisions:
        if d.step in shown:
            outcome = (int(d.failed), d.collected, d.lost_packets, round(d.cost, 3))
            by_step[d.step].append([d.uav_id, d.sensor_id, d.velocity, d.source, *outcome])
    each = max(2, min(_POINTS_EACH, _POINTS // scenario.uavs))
    mission = {
        "steps": scenario.steps,
        "capacity": scenario.queue_capacity,
        "area": scenario.area_m,
        "sensors": _rounded(sensor_xy),
        "pipeline": _rounded(scenario.pipeline) if scenario.layout != "uniform" else [],
        "trajectories": [_rounded(path.at(np.linspace(0.0, path.length_m, each))) for path in trajectories(scenario)],
        "frames": [_frame(one, by_step[one.step], scenario.battery_j) for one in instants],
    }
    return Playback(mission, stride, files("simulator.reporting").joinpath("playback.js").read_text(encoding="utf-8"))


def _frame(instant: Instant, decisions: list[list[Any]], battery_j: float) -> dict[str, Any]:
    return {
        "step": instant.step,
        "uavs": [[uav, round(x, 1), round(y, 1)] for uav, (x, y) in sorted(instant.positions.items())],
        "queue": instant.queue.tolist(),
        "battery": np.ceil(100 * instant.battery / battery_j).astype(int).tolist(),
        "lost": instant.lost.tolist(),
        "decisions": decisions,
    }


def _rounded(points: Any) -> list[list[float]]:
    return [[round(x, 1), round(y, 1)] for x, y in np.asarray(points, dtype=float).reshape(-1, 2).tolist()]


COSTLIEST_DECISIONS = 15


def costliest(decisions: Sequence[Decision]) -> list[Decision]:
    """The decisions with the highest cost above 0; of equals the earlier one first."""
    costly = [d for d in decisions if d.cost > 0]
    return sorted(costly, key=lambda d: (-d.cost, d.step, d.uav_id))[:COSTLIEST_DECISIONS]


def drawings(
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[StepTally]],
    sensor_xy: np.ndarray,
) -> dict[str, PaperFigure]:
    """The figures of this mission by their name in the page.

    Args:
        summary: the content of ``summary.json``.
        scenario: of the mission, for the trajectories.
        decisions: in order of step and UAV; may be empty.
        tallies: by policy, one entry a step flown.
        sensor_xy: (J, 2), metres.
    """
    drawn = {
        "losses": figures.losses(tallies, policy_labels(summary)),
        "visits": figures.visits(decisions, scenario.sensors, (summary.names or Names()).sensors),
    }
    if summary.policy == "edge":
        drawn["map"] = figures.latency_map(scenario, sensor_xy, decisions)
        drawn["latency"] = figures.latency_per_step(decisions)
        drawn["deciders"] = figures.deciders(decisions)
    if summary.llm_asked:
        drawn["tokens"] = figures.tokens_per_step(decisions)
    return drawn


def render_report(
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    drawn: Mapping[str, PaperFigure],
    played: Playback | None = None,
) -> str:
    """The page as HTML; arguments as for ``drawings``, ``drawn`` is its result, and ``played`` a flight's playback."""
    pages = Environment(loader=PackageLoader("simulator.reporting", "."), autoescape=True, undefined=StrictUndefined)
    pages.trim_blocks = pages.lstrip_blocks = True
    pages.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    pages.filters["number"] = number
    pages.filters["percent"] = percent
    names = summary.names or Names()
    pages.filters["sensor"] = lambda id_: dict(enumerate(names.sensors)).get(id_) or id_
    pages.filters["uav"] = lambda id_: dict(enumerate(names.uavs)).get(id_) or id_
    pages.filters["named"] = lambda text: with_names(text, names)
    labels = policy_labels(summary)
    return pages.get_template("report.html.j2").render(
        s=summary,
        ours=next(iter(summary.lost_packets)),
        labels=labels,
        verdict=verdict(summary),
        world=world_text(summary),
        late=late_text(summary),
        bound=bound_text(summary),
        orders=orders_text(summary),
        advisers={name: ADVISERS.get(name, name) for name in summary.trust},
        notice=llm_notice(summary),
        sources=summary.by_source.present(),
        scenario=scenario,
        figures={name: Markup(one.inline) for name, one in drawn.items()},
        costliest=costliest(decisions),
        maps=min(scenario.uavs, figures.MAPS),
        playback=played,
    )


def write_report(
    path: Path,
    summary: Summary,
    scenario: Scenario,
    decisions: Sequence[Decision],
    tallies: Mapping[str, Sequence[StepTally]],
    sensor_xy: np.ndarray,
    track: Track,
) -> None:
    """Write the page, and its figures for print into the folder ``figures/`` next to it.

    The first arguments are those of ``drawings``; ``track`` is what the playback shows.

    Raises:
        OSError: a file cannot be written.
    """
    drawn = drawings(summary, scenario, decisions, tallies, sensor_xy)
    played = playback(scenario, sensor_xy, decisions, track.until(summary.steps_flown), track.stride)
    if played is not None:
        played.mission["names"] = (summary.names or Names()).model_dump()
    path.write_text(render_report(summary, scenario, decisions, drawn, played), encoding="utf-8")
    folder = path.parent / FIGURES
    folder.mkdir(exist_ok=True)
    for one in drawn.values():
        one.write(folder)
