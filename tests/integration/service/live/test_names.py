"""The user's names and map: kept with the mission, in its page's snapshot and its note's reading, and in no metric."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest

from shared.planning.orders import Guidance, SensorWish
from shared.wire.names import with_names
from shared.wire.schemas import MissionSpec
from simulator.sites.files.world_folder import site_from_folder
from tests.conftest import Edge
from tests.integration.service.guidance.test_operator_guidance import Scribe, guidance
from tests.support.running import serving
from tests.support.stored_missions import running
from tests.support.stub_llm import wait_for
from tests.support.world_folders import EXAMPLE

SITE = site_from_folder(EXAMPLE)
SPEC = json.loads(SITE.named(MissionSpec(scenario=SITE.scenario, mode="value")).model_dump_json(exclude_none=True))


def snapshot(client: httpx.Client, mission: str) -> dict[str, object]:
    with client.stream("GET", f"/missions/{mission}/events") as events:
        for line in events.iter_lines():
            if line.startswith("data: "):
                found: dict[str, object] = json.loads(line.removeprefix("data: "))
                return found
    raise AssertionError("no snapshot")


def test_names_and_map_survive_a_restart_and_are_part_of_the_spec(tmp_path: Path) -> None:
    for _ in range(2):
        with running(tmp_path / "m.db") as (client, _settings):
            assert client.put("/missions/m", json=SPEC).json()["names"] == SPEC["names"]
            assert client.get("/missions/m").json()["names"]["sensors"][3] == "kp-1.58"
            shown = snapshot(client, "m")
            assert (shown["names"], shown["map"]) == (SPEC["names"], SPEC["map"])
            # A surveyed world's sensors are known before the first report.
            assert shown["places"] == [[pytest.approx(x, abs=0.051) for x in site] for site in SITE.scenario.sites]
            other = SPEC | {"names": {"sensors": ["other"]}}
            assert client.put("/missions/m", json=other).status_code == 409


def test_a_note_with_names_is_read_as_ids_and_shown_with_both(edge: Edge) -> None:
    scribe = Scribe("visit sensor 3 every 3 steps")
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json=SPEC | {"note": "Leak at KP-1.58, kp-1.5: visit it every 3 steps."})
        reported = guidance(client, "proposed")
        assert reported["note"] == "Leak at KP-1.58, kp-1.5: visit it every 3 steps."
        assert reported["guidance"]["sensors"][0]["sensor_id"] == 3
        assert "“kp-1.5” is no name of this mission." in reported["doubts"]
        shown = snapshot(client, "test")["guidance"]
        assert isinstance(shown, dict)
        assert shown["in_words"] == "Visit sensor 3 (kp-1.58) at least once in every 3 steps."
        assert "kp-" not in client.get("/metrics").text


def test_a_note_that_is_not_understood_says_which_name_it_does_not_know(edge: Edge) -> None:
    with serving(Scribe("gibberish").app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json=SPEC | {"note": "Somebody heard kp-1.5 hum, keep 3 eyes on it."})
        assert guidance(client, "failed")["failure"].startswith("“kp-1.5” is no name of this mission. ")


def test_orders_of_sensors_without_a_name_stay_as_they_are() -> None:
    words = Guidance(sensors=[SensorWish(sensor_id=3, visit_every=2), SensorWish(sensor_id=99, weight=2.0)]).in_words()
    assert with_names(words, SITE.names) == words.replace("sensor 3", "sensor 3 (kp-1.58)")
    assert with_names(words, None) == words
    assert with_names("UAV 1 and UAV 7 landed.", SITE.names) == "UAV 1 (valve station, laps) and UAV 7 landed."


@pytest.mark.parametrize(
    "wrong",
    [
        {"names": {"sensors": ["a\nb"]}},
        {"names": {"sensors": ["a\u202eb"]}},
        {"names": {"sensors": [" "]}},
        {"names": {"uavs": ["x" * 65]}},
        {"names": {"sensors": ["x"] * 2001}},
        {"names": {"fences": ["x"]}},
        {"map": [{"kind": "line", "points": [[0, 0]]}]},
        {"map": [{"kind": "sensor", "points": [[0, 0], [1, 1]]}]},
        {"map": [{"kind": "line", "points": [[0, 0], [1e9, 1]]}]},
        {"map": [{"kind": "line", "points": [[0, 0]] * 1001}]},
        {"map": [{"kind": "line", "points": [[0, 0], [1, 1]]}] * 301},
    ],
)
def test_names_and_map_are_bounded(edge: Edge, wrong: dict[str, object]) -> None:
    refused = edge().put("/missions/m", json=wrong)
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["field"].startswith(next(iter(wrong)))


def test_an_order_is_withdrawn_by_its_id_where_sensors_are_named_by_other_numbers(edge: Edge) -> None:
    client = edge()
    names = {"sensors": [str(sensor + 1) for sensor in range(10)]}
    client.put("/missions/test", json={"names": names})
    wishes = [{"sensor_id": sensor, "visit_every": 4} for sensor in (3, 4)]
    client.post("/missions/test/guidance", json={"guidance": {"sensors": wishes}})
    client.post("/missions/test/guidance", json={"answer": "confirm"})
    after = client.post("/missions/test/guidance", json={"answer": "withdraw", "orders": ["visit:4"]}).json()
    assert [wish["sensor_id"] for wish in after["guidance"]["sensors"]] == [3], after
