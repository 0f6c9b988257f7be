"""Reports that leave out what the edge has: completed to the full report's own decision, or refused without a trace."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from shared.wire.problem import INCOMPLETE
from tests.support.stored_missions import running

Body = dict[str, Any]
Report = Callable[..., Body]
Edge = Callable[..., httpx.Client]


def asked(client: httpx.Client, body: Body, **headers: str) -> Body:
    answer = client.post("/decide", json=body, headers=headers)
    assert answer.status_code == 200, answer.text
    reported: Body = answer.json()
    return reported


def changed(report: Report, base: str, step: int, **rows: list[Any]) -> Body:
    """A report of sensors that changed; unless told otherwise sensor 1, heard again."""
    sensors: Body = {"id": [1], "queue": [29.5], "battery": [49.5], "channel_gain": [-91.25], "last_seen": [step]}
    return report(step=step, base=base, sensors={**sensors, **rows})


def whole(report: Report, step: int) -> Body:
    """The full report of the same."""
    sensors = report()["sensors"]
    reported = {"queue": 29.5, "battery": 49.5, "channel_gain": -91.25, "last_seen": step}
    return report(
        step=step, sensors=sensors | {name: [sensors[name][0], v, *sensors[name][2:]] for name, v in reported.items()}
    )


def said(answer: Body) -> Body:
    """What is decided, and why."""
    return {name: answer[name] for name in ("sensor_id", "velocity", "source", "reason", "top_k", "tokens")}


def refusal(client: httpx.Client, body: Body, path: str = "/decide") -> tuple[int, str, str]:
    """Status, type and field of a refusal, which leaves no trace."""
    before = client.get("/missions/test").json()
    problem = (answer := client.post(path, json=body)).json()
    assert client.get("/missions/test").json() == before
    return answer.status_code, problem["type"], problem["errors"][0]["field"]


def test_degrees_are_refused_and_metres_near_the_corner_are_not(edge: Edge, report: Report) -> None:
    client, sensors = edge(), report()["sensors"]
    client.put("/missions/test", json={}).raise_for_status()
    longitudes, latitudes = [41.2949, 41.2962, 41.2974, 41.2983, 41.2992], [39.8965, 39.8970, 39.8978, 39.8987, 39.8998]
    in_degrees = report(position=[41.3012345, 39.9023456], sensors={**sensors, "x": longitudes, "y": latitudes})
    assert refusal(client, in_degrees) == (422, "about:blank", "position")
    # The sensors are in metres, or their places are known.
    assert refusal(client, report(position=[41.3012345, 39.9023456])) == (422, "about:blank", "position")
    for position in ([41.301, 39.902], [41.0, 39.9023456], [180.5123456, 39.9023456]):
        asked(client, report(position=position))
    # A UAV that has flown in metres goes on in metres.
    asked(client, report(step=1, position=[41.3012345, 39.9023456]))


@pytest.mark.parametrize("belief", ["fleet", "reported"])
def test_what_changed_decides_as_all_of_it(edge: Edge, report: Report, belief: str) -> None:
    clients = [edge(), edge()]
    for client in clients:
        client.put("/missions/test", json={"belief": belief}).raise_for_status()
    first = [asked(client, report(uplink="delta")) for client in clients]
    delta = asked(clients[0], changed(report, first[0]["decision_id"], 1))
    assert said(delta) == said(asked(clients[1], whole(report, 1)))
    nothing_new: Body = {"id": [], "queue": [], "battery": [], "channel_gain": [], "last_seen": []}
    delta = asked(clients[0], report(step=2, base=delta["decision_id"], sensors=nothing_new))
    full = {**whole(report, 1), "step": 2}
    assert said(delta) == said(asked(clients[1], full)) and len(delta["top_k"]) > 1


def test_a_base_is_the_uavs_last_that_was_answered(edge: Edge, report: Report) -> None:
    client = edge()
    first = asked(client, report(uplink="delta"))["decision_id"]
    second = asked(client, changed(report, first, 1))["decision_id"]
    incomplete = (409, INCOMPLETE, "base")
    assert refusal(client, changed(report, first, 2)) == incomplete, "an older one"
    assert refusal(client, {**changed(report, second, 2), "uav_id": 1}) == incomplete, "another UAV's"
    assert refusal(client, changed(report, "0" * 32, 2)) == incomplete, "nobody's"
    assert refusal(client, {**changed(report, second, 0), "sensors": whole(report, 0)["sensors"]}) == (
        422,
        "about:blank",
        "base",
    ), "one of the future"
    asked(client, changed(report, second, 1))


def test_only_who_asks_for_it_has_a_base(edge: Edge, report: Report) -> None:
    client = edge()
    first = asked(client, report())["decision_id"]
    assert refusal(client, changed(report, first, 1))[:2] == (409, INCOMPLETE)
    second = asked(client, report(uplink="delta"))["decision_id"]
    # A full report that does not ask takes the place of one that did.
    asked(client, report())
    assert refusal(client, changed(report, second, 1))[:2] == (409, INCOMPLETE)


def test_a_base_is_gone_with_its_mission_and_its_process(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        first = asked(client, report(uplink="delta"))["decision_id"]
        client.delete("/missions/test").raise_for_status()
        answer = client.post("/decide", json=changed(report, first, 1))
        assert (answer.status_code, answer.json()["type"]) == (409, INCOMPLETE)
        assert client.get("/missions/test").status_code == 404, "a refusal makes no mission"
        second = asked(client, report(uplink="delta"))["decision_id"]
    with running(tmp_path / "m.db") as (client, _):
        assert refusal(client, changed(report, second, 1)) == (409, INCOMPLETE, "base")
        # Places are among what a restart keeps.
        sensors = {name: column for name, column in report(step=1)["sensors"].items() if name not in ("x", "y")}
        third = asked(client, report(step=1, sensors=sensors, uplink="delta"))
        asked(client, changed(report, third["decision_id"], 2))


def test_the_mission_that_is_read_back_is_that_of_full_reports(tmp_path: Path, report: Report) -> None:
    states = []
    for name in ("delta", "full"):
        with running(tmp_path / f"{name}.db") as (client, _):
            first = asked(client, report(uplink="delta"))["decision_id"]
            asked(client, changed(report, first, 1) if name == "delta" else whole(report, 1))
        with running(tmp_path / f"{name}.db") as (client, engine):
            assert client.get("/missions/test").json()["decisions"] == 2
            state = engine.missions.loaded[0].state_dict()
            # By the decisions' random IDs.
            del state["records"]["open"]
            states.append({part: str(state[part]) for part in ("records", "belief", "decisions")})
    assert states[0] == states[1]


def test_a_delta_sent_again_gets_its_answer(tmp_path: Path, report: Report) -> None:
    with running(tmp_path / "m.db") as (client, _):
        first = asked(client, report(uplink="delta"))["decision_id"]
        delta = changed(report, first, 1)
        second = asked(client, delta, **{"Idempotency-Key": "k1"})
        # Its base has been replaced by itself.
        assert asked(client, delta, **{"Idempotency-Key": "k1"})["decision_id"] == second["decision_id"]
        other = client.post("/decide", json=changed(report, first, 2), headers={"Idempotency-Key": "k1"})
        assert (other.status_code, other.json()["errors"][0]["field"]) == (422, "Idempotency-Key")
        refused = client.post("/decide", json=changed(report, first, 2), headers={"Idempotency-Key": "k2"})
        assert refused.json()["type"] == INCOMPLETE
        # A refusal uses no key up.
        asked(client, whole(report, 2), **{"Idempotency-Key": "k2"})
        assert client.get("/missions/test").json()["decisions"] == 3


def test_deltas_of_a_batch(tmp_path: Path, report: Report) -> None:
    def batch(*uavs: Body, step: int) -> Body:
        kept = ("uav_id", "position", "sensors", "base", "uplink")
        return {"mission_id": "test", "step": step, "uavs": [{k: u[k] for k in kept if k in u} for u in uavs]}

    with running(tmp_path / "m.db", mode="guided", llm_gguf="none") as (client, _):
        fleet = [report(uav_id=uav, uplink="delta") for uav in range(3)]
        first = client.post("/decide/batch", json=batch(*fleet, step=0)).json()["decisions"]
        deltas = [{**changed(report, d["decision_id"], 1), "uav_id": d["uav_id"]} for d in first]
        swapped = [{**delta, "base": first[0]["decision_id"]} for delta in deltas]
        reported = refusal(client, batch(*swapped, step=1), "/decide/batch")
        assert reported == (409, INCOMPLETE, "uavs[1].base")
        answers: list[Any] = []

        def ask() -> None:
            body = batch(*deltas, step=1)
            answers.append(client.post("/decide/batch", json=body, headers={"Idempotency-Key": "k"}).json())

        # Sent again while it is under way, when the bases of some of its UAVs have been replaced already.
        threads = [threading.Thread(target=ask) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len({tuple(d["decision_id"] for d in answer["decisions"]) for answer in answers}) == 1
        assert client.get("/missions/test").json()["decisions"] == 6


@pytest.mark.parametrize(
    ("rows", "status", "field"),
    [
        ({"id": [7]}, 422, "sensors.id"),
        ({"id": [10]}, 422, "sensors.id"),
        ({"queue": [1.0, 2.0]}, 422, "sensors"),
        ({"queue": [61.0]}, 422, "sensors.queue"),
        ({"queue": [None]}, 422, "sensors"),
        ({"last_seen": [2]}, 422, "sensors.last_seen"),
        ({"x": [1.0]}, 422, "sensors"),
        ({"x": [1.0, 2.0], "y": [1.0, 2.0]}, 422, "sensors"),
    ],
)
def test_changes_that_are_none(edge: Edge, report: Report, rows: Body, status: int, field: str) -> None:
    client = edge()
    base = asked(client, report(uplink="delta"))["decision_id"]
    reported = refusal(client, changed(report, base, 1, **rows))
    assert (reported[0], reported[2]) == (status, field)
    asked(client, changed(report, base, 1))


def test_places_may_be_told_anew_with_a_base(edge: Edge, report: Report) -> None:
    clients = [edge(), edge()]
    base = [asked(client, report(uplink="delta"))["decision_id"] for client in clients]
    moved = asked(clients[0], changed(report, base[0], 1, x=[500.0], y=[440.0]))
    full = whole(report, 1)
    full["sensors"]["x"][1], full["sensors"]["y"][1] = 500.0, 440.0
    assert said(moved) == said(asked(clients[1], full))


def test_places_that_nobody_told(edge: Edge, report: Report) -> None:
    client = edge()
    base = asked(client, report(uplink="delta"))["decision_id"]
    row: Body = {"id": [7], "queue": [5.0], "battery": [49.5], "channel_gain": [-91.25], "last_seen": [1]}
    assert refusal(client, report(step=1, sensors=row)) == (409, INCOMPLETE, "sensors.x")
    nobody: Body = {name: [] for name in report()["sensors"]}
    assert refusal(client, report(step=1, sensors=nobody)) == (422, "about:blank", "sensors")
    # Another UAV's word is as good.
    asked(client, report(step=1, uav_id=1, sensors={**row, "x": [700.0], "y": [410.0]}))
    asked(client, report(step=1, sensors=row))
    assert refusal(client, changed(report, base, 2))[:2] == (409, INCOMPLETE), "that report asked for no base"


def test_a_base_takes_little(edge: Edge, report: Report, tmp_path: Path) -> None:
    with running(tmp_path / "m.db") as (client, engine):
        for step in range(4):
            asked(client, report(step=step, uplink="delta"))
        (held,) = engine.missions.loaded[0].reports._references.values()
        assert held.columns.nbytes == 5 * 8 * 5
        asked(client, report(step=5))
        assert not engine.missions.loaded[0].reports._references
