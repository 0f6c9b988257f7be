"""The HTTP interface against a real server: what it answers, what it refuses, and that refusals leave no trace."""

import gzip
import json
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import httpx
import pytest
import zstandard

from tests.support.waiting import until

Body = dict[str, Any]
Report = Callable[..., Body]
Edge = Callable[..., httpx.Client]


def columns(n: int) -> Body:
    """n sensors, all heard."""
    return {
        "id": list(range(n)),
        "x": [1.0] * n,
        "y": [1.0] * n,
        "queue": [1] * n,
        "battery": [1.0] * n,
        "channel_gain": [-90.0] * n,
        "last_seen": [0] * n,
    }


def fields(response: httpx.Response) -> list[str]:
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["status"] == response.status_code
    return [error["field"] for error in problem["errors"]]


def test_decides_and_says_how(edge: Edge, report: Report) -> None:
    response = edge().post("/decide", json=report())
    assert response.status_code == 200, response.text
    answer = response.json()
    assert (answer["source"], answer["reason"]) == ("value", "mode_value")
    assert answer["sensor_id"] in [0, 1, 2, 3, 4]
    assert 0 <= answer["velocity"] <= 14
    assert answer["sensor_id"] == answer["top_k"][0]["sensor_id"]
    scores = [c["score"] for c in answer["top_k"]]
    assert scores == sorted(scores, reverse=True)
    # Of the sensor never heard the fleet expects what the scenario draws from.
    assert len(scores) == 5
    assert answer["tokens"]["saved"] == answer["tokens"]["state_uncompressed"] - answer["tokens"]["state"] == 0
    stages = response.headers["server-timing"]
    assert all(f"{stage};dur=" in stages for stage in ("augment", "attend", "prompt", "check", "total"))


def test_same_seed_same_decision_on_two_edges(edge: Edge, report: Report) -> None:
    answers = [client.post("/decide", json=report()).json() for client in (edge(), edge())]
    assert answers[0]["top_k"] == answers[1]["top_k"]
    assert answers[0]["velocity"] == answers[1]["velocity"]


def test_uavs_of_one_step_get_different_sensors(edge: Edge, report: Report) -> None:
    client = edge()
    given = [client.post("/decide", json=report(uav_id=uav)).json()["sensor_id"] for uav in range(3)]
    assert len(set(given)) == 3
    # A UAV that asks again gives its own reservation back.
    assert client.post("/decide", json=report(uav_id=0)).json()["sensor_id"] == given[0]


def test_batch_reserves_in_order(edge: Edge, report: Report) -> None:
    uavs = [{k: report()[k] for k in ("position", "sensors")} | {"uav_id": uav} for uav in range(3)]
    response = edge().post("/decide/batch", json={"mission_id": "test", "step": 0, "uavs": uavs})
    assert response.status_code == 200, response.text
    given = [d["sensor_id"] for d in response.json()["decisions"]]
    assert len(set(given)) == 3


def test_uavs_that_report_nothing_but_one_sensor_still_get_different_ones(edge: Edge, report: Report) -> None:
    client = edge()
    only = {k: v[3:4] for k, v in report()["sensors"].items()}
    given = [client.post("/decide", json=report(uav_id=uav, sensors=only)).json()["sensor_id"] for uav in range(3)]
    assert len(set(given)) == 3


@pytest.mark.parametrize(("column", "value"), [("id", 77), ("queue", 61), ("last_seen", 1)])
def test_a_batch_names_the_uav_at_fault(edge: Edge, report: Report, column: str, value: int) -> None:
    client = edge()
    uavs = [{k: report()[k] for k in ("position", "sensors")} | {"uav_id": uav} for uav in range(2)]
    uavs[1]["sensors"][column][0] = value
    response = client.post("/decide/batch", json={"mission_id": "test", "step": 0, "uavs": uavs})
    assert (response.status_code, fields(response)) == (422, [f"uavs[1].sensors.{column}"])
    assert client.get("/missions/test").status_code == 404


def test_a_batch_uses_every_outcome_before_it_decides(edge: Edge, report: Report) -> None:
    """Also those of decisions so old that the batch itself would make the mission forget them."""
    client = edge()
    ids = [client.post("/decide", json=report(step=step, uav_id=1)).json()["decision_id"] for step in range(8)]
    states = [{k: report(step=8)[k] for k in ("position", "sensors")} | {"uav_id": uav} for uav in (0, 1)]
    states[1]["outcome"] = {"decision_id": ids[0], "cost": 0.5}
    assert client.post("/decide/batch", json={"mission_id": "test", "step": 8, "uavs": states}).status_code == 200
    assert client.get("/missions/test").json()["feedback"] == 1


def test_a_uav_that_has_heard_nothing_still_gets_an_answer(edge: Edge, report: Report) -> None:
    body = report()
    for column in ("queue", "battery", "channel_gain", "last_seen"):
        body["sensors"][column] = [None] * 5
    client = edge()
    client.put("/missions/test", json={"belief": "reported"})
    answer = client.post("/decide", json=body).json()
    assert (answer["source"], answer["reason"], answer["top_k"]) == ("policy", "no_candidate", [])


def test_feedback_is_applied_once(edge: Edge, report: Report) -> None:
    client = edge()
    decision = client.post("/decide", json=report()).json()["decision_id"]
    outcome = {"decision_id": decision, "cost": 0.5}
    results = [client.post("/feedback", json={"mission_id": "test", **outcome}).json()["result"] for _ in range(3)]
    assert results == ["applied", "duplicate", "duplicate"]
    # The same outcome with the next request is a duplicate too, and no error.
    assert client.post("/decide", json=report(step=1, outcome=outcome)).status_code == 200
    assert client.get("/missions/test").json()["feedback"] == 1


def test_feedback_for_an_unknown_decision_is_a_404(edge: Edge, report: Report) -> None:
    client = edge()
    client.post("/decide", json=report())
    unknown = {"decision_id": "0" * 32, "cost": 0.5}
    response = client.post("/feedback", json={"mission_id": "test", **unknown})
    assert (response.status_code, fields(response)) == (404, ["decision_id"])
    response = client.post("/feedback", json=unknown)
    assert (response.status_code, fields(response)) == (404, ["decision_id"])
    assert "name its mission_id" in response.json()["detail"]
    response = client.post("/feedback", json={"mission_id": "nobody", **unknown})
    assert (response.status_code, fields(response)) == (404, ["mission_id"])
    response = client.post("/decide", json=report(step=1, outcome=unknown))
    assert (response.status_code, fields(response)) == (404, ["outcome.decision_id"])
    assert client.get("/missions/test").json()["decisions"] == 1


def test_a_failed_transmission_was_no_visit(edge: Edge, report: Report) -> None:
    client = edge()
    answer = client.post("/decide", json=report(step=4)).json()
    assert client.get("/missions/test").json()["visits"] == {str(answer["sensor_id"]): 4}
    client.post(
        "/feedback", json={"mission_id": "test", "decision_id": answer["decision_id"], "cost": 1, "failed": True}
    )
    assert client.get("/missions/test").json()["visits"] == {}


BAD: list[tuple[str, Callable[[Body], Any], str]] = [
    ("no sensors", lambda b: b["sensors"].update({k: [] for k in b["sensors"]}), "sensors"),
    ("no sensors column", lambda b: b.pop("sensors"), "sensors"),
    ("ragged", lambda b: b["sensors"]["queue"].pop(), "sensors"),
    ("duplicate IDs", lambda b: b["sensors"]["id"].__setitem__(1, 0), "sensors"),
    ("unknown sensor", lambda b: b["sensors"]["id"].__setitem__(1, 77), "sensors.id"),
    ("unknown UAV", lambda b: b.update(uav_id=3), "uav_id"),
    ("negative queue", lambda b: b["sensors"]["queue"].__setitem__(0, -1), "sensors.queue[0]"),
    ("queue past its capacity", lambda b: b["sensors"]["queue"].__setitem__(0, 61), "sensors.queue"),
    ("string for a number", lambda b: b["sensors"]["queue"].__setitem__(0, "5"), "sensors.queue[0]"),
    ("half a beacon", lambda b: b["sensors"]["queue"].__setitem__(0, None), "sensors"),
    ("beacon from the future", lambda b: b["sensors"]["last_seen"].__setitem__(0, 1), "sensors.last_seen"),
    ("true for a step", lambda b: b.update(step=True), "step"),
    ("three coordinates", lambda b: b.update(position=[1.0, 2.0, 3.0]), "position"),
    ("unknown field", lambda b: b.update(velocity=3), "velocity"),
    ("mission ID with a slash", lambda b: b.update(mission_id="a/b"), "mission_id"),
    ("lone surrogate", lambda b: b.update(mission_id="\ud800"), "mission_id"),
    ("cost below zero", lambda b: b.update(outcome={"decision_id": "0" * 32, "cost": -1}), "outcome.cost"),
    ("no time at all", lambda b: b.update(deadline_ms=0), "deadline_ms"),
]


@pytest.mark.parametrize(("spoil", "field"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_bad_input_is_refused_by_field_and_recorded_nowhere(
    edge: Edge, report: Report, spoil: Callable[[Body], Any], field: str
) -> None:
    client, body = edge(), report()
    spoil(body)
    response = client.post("/decide", content=json.dumps(body), headers={"content-type": "application/json"})
    assert response.status_code == 422, response.text
    assert any(name.startswith(field) for name in fields(response)), response.text
    assert client.get("/missions/test").status_code == 404


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "9" * 5000])
def test_numbers_that_are_none(edge: Edge, report: Report, number: str) -> None:
    text = json.dumps(report()).replace("-83.1", number)
    assert number in text
    client = edge()
    response = client.post("/decide", content=text, headers={"content-type": "application/json"})
    assert response.status_code in (400, 422)
    assert response.headers["content-type"] == "application/problem+json"
    assert client.get("/missions/test").status_code == 404


@pytest.mark.parametrize("body", [b"", b"{", b"\xff", b"[" * 100_000])
def test_bodies_that_are_no_json(edge: Edge, body: bytes) -> None:
    response = edge().post("/decide", content=body, headers={"content-type": "application/json"})
    assert response.status_code in (400, 422), response.text
    assert fields(response) == ["body"]
    assert ("is not UTF-8" in response.json()["detail"]) == (body == b"\xff")


def test_a_cut_upload_is_not_recorded(edge: Edge, report: Report) -> None:
    client = edge()
    body = json.dumps(report()).encode()
    head = "POST /decide HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
    head += f"content-length: {len(body) + 9}\r\n\r\n"
    with socket.create_connection((client.base_url.host, client.base_url.port or 0)) as cut:
        cut.sendall(head.encode() + body)
    assert client.get("/healthz").status_code == 200
    assert client.get("/missions/test").status_code == 404


def test_too_many_sensors(edge: Edge, report: Report) -> None:
    client = edge(max_body_bytes=200_000_000)
    response = client.post("/decide", json=report(sensors=columns(100_000)))
    assert response.status_code == 422
    assert "sensors.id" in fields(response)
    response = edge(max_body_bytes=1_000_000).post("/decide", json=report(sensors=columns(100_000)))
    assert (response.status_code, fields(response)) == (413, ["body"])


@pytest.mark.parametrize(("encoding", "squeeze"), [("gzip", gzip.compress), ("zstd", zstandard.compress)])
def test_compressed_bodies(edge: Edge, report: Report, encoding: str, squeeze: Callable[[bytes], bytes]) -> None:
    client, headers = edge(), {"content-type": "application/json", "content-encoding": encoding}
    packed = squeeze(json.dumps(report()).encode())
    assert client.post("/decide", content=packed, headers=headers).status_code == 200
    bomb = client.post("/decide", content=squeeze(b" " * 50_000_000), headers=headers)
    assert (bomb.status_code, fields(bomb)) == (413, ["body"])
    for trailing in (packed + b"garbage", packed + packed):
        followed = client.post("/decide", content=trailing, headers=headers)
        assert (followed.status_code, fields(followed)) == (400, ["body"])
    damaged = client.post("/decide", content=packed[:20], headers=headers)
    assert (damaged.status_code, fields(damaged)) == (400, ["body"])
    assert client.post("/decide", content=b"x", headers={**headers, "content-encoding": "br"}).status_code == 415


def test_missions(edge: Edge, report: Report) -> None:
    client = edge(max_missions=2)
    made = client.put("/missions/a", json={"scenario": "stress", "top_k": 3})
    assert made.status_code == 200, made.text
    assert (made.json()["scenario"]["link_share"], made.json()["top_k"]) == (0.35, 3)
    assert client.put("/missions/a", json={"scenario": "stress", "top_k": 3}).status_code == 200
    assert client.put("/missions/a", json={"scenario": "paper"}).status_code == 409
    assert len(client.post("/decide", json=report(mission_id="a")).json()["top_k"]) == 3
    unknown = client.put("/missions/b", json={"scenario": "moon"})
    assert (unknown.status_code, fields(unknown)) == (422, ["scenario"])
    for wrong, field in (("12", "sensors"), (True, "queue_capacity"), (0, "sensors"), (float(2), "uavs")):
        refused = client.put("/missions/b", json={"scenario": {field: wrong}})
        assert (refused.status_code, fields(refused)[0]) == (422, f"scenario.{field}"), refused.text
    custom = client.put("/missions/b", json={"scenario": {**made.json()["scenario"], "name": "own", "uavs": 1}})
    assert custom.status_code == 200, custom.text
    assert client.post("/decide", json=report(mission_id="b", uav_id=1)).status_code == 422
    full = client.post("/decide", json=report(mission_id="c"))
    assert (full.status_code, fields(full)) == (409, ["mission_id"])
    assert client.delete("/missions/a").status_code == 204
    assert client.delete("/missions/a").status_code == 404
    assert client.post("/decide", json=report(mission_id="c")).status_code == 200


def test_a_mission_says_how_it_shows_the_sensors(edge: Edge, report: Report) -> None:
    client = edge(mode="llm", llm_gguf="none")
    plain = client.put("/missions/plain", json={}).json()
    assert plain["prompt"] == {
        "format": "csv",
        "order": "score",
        "experiences": 30,
        "selection": "recent",
        "demonstrations": 0,
    }
    assert (plain["attention"], plain["features"]) == ("on", "paper")
    spec = {"prompt": {"format": "csv", "order": "shuffled", "experiences": 0}, "attention": "off", "top_k": 1}
    made = client.put("/missions/shuffled", json=spec).json()
    assert (made["prompt"], made["attention"]) == (plain["prompt"] | spec["prompt"], "off")
    answer = client.post("/decide", json=report(mission_id="shuffled")).json()
    assert [c["sensor_id"] for c in answer["top_k"]] == [0, 1, 2, 3]
    for wrong in (
        {"format": "json"},
        {"order": "best"},
        {"experiences": 101},
        {"experiences": -1},
        {"rows": 1},
        {"selection": "worst"},
        {"demonstrations": 1},
    ):
        refused = client.put("/missions/wrong", json={"prompt": wrong})
        assert (refused.status_code, fields(refused)) == (422, [f"prompt.{next(iter(wrong))}"]), refused.text
    long = client.put("/missions/long", json={"scenario": "dense", "prompt": {"experiences": 100}, "top_k": 20})
    assert (long.status_code, fields(long)) == (422, ["prompt"])
    assert "AICVDS_LLM_CONTEXT" in long.text
    assert client.get("/missions/long").status_code == 404


def test_a_mission_may_look_ahead(edge: Edge, report: Report) -> None:
    client = edge()
    assert client.put("/missions/ahead", json={"features": "reach"}).json()["features"] == "reach"
    reported, off = report(mission_id="ahead", step=0, progress_m=0.0), report(mission_id="ahead", step=1)
    for body in (reported, off):
        answer = client.post("/decide", json=body)
        assert (answer.status_code, answer.json()["source"]) == (200, "value"), answer.text
    outcome = {"decision_id": answer.json()["decision_id"], "cost": 1.0}
    assert client.post("/feedback", json={"mission_id": "ahead", **outcome}).json()["result"] == "applied"


def test_metrics_tell_what_happened_and_name_no_one(edge: Edge, report: Report) -> None:
    client = edge()
    decision = client.post("/decide", json=report(mission_id="secret")).json()["decision_id"]
    client.post("/feedback", json={"mission_id": "secret", "decision_id": decision, "cost": 0.5})
    text = client.get("/metrics").text
    assert 'aicvds_decisions_total{reason="mode_value",source="value"} 1.0' in text
    assert 'aicvds_feedback_total{result="applied"} 1.0' in text
    assert 'aicvds_decision_seconds_count{stage="total"} 1.0' in text
    assert "aicvds_overhead_seconds_count 1.0" in text
    assert "secret" not in text


def test_operation(edge: Edge) -> None:
    client = edge()
    assert client.get("/healthz").json() == {"status": "ok"}
    ready = client.get("/readyz").json()
    assert (ready["ready"], ready["decides"], ready["llm"]) == (True, "value", "off")
    assert "<title>AIC-VDS mission</title>" in client.get("/").text
    assert client.get("/nowhere").headers["content-type"] == "application/problem+json"
    assert client.get("/decide").status_code == 405


def test_the_modules_learn_from_feedback(edge: Edge, report: Report) -> None:
    client, outcome = edge(), None
    scores = []
    for step in range(12):
        answer = client.post("/decide", json=report(step=step, outcome=outcome)).json()
        outcome = {"decision_id": answer["decision_id"], "cost": 2.0}
        scores.append(answer["top_k"][0]["score"])
    until(lambda: client.get("/missions/test").json()["learner_updates"] == 11)
    status = client.get("/missions/test").json()
    assert status["learner_updates"] == status["feedback"] == 11
    assert status["learner_loss"] > 0
    assert "aicvds_learner_loss 0.0" not in client.get("/metrics").text


def updates_of(client: httpx.Client, mission: str) -> int:
    return int(client.get(f"/missions/{mission}").json()["learner_updates"])


def test_a_forged_cost_teaches_no_more_than_the_worst_that_can_be(edge: Edge, report: Report) -> None:
    """Ten sensors that overflow and three transmissions that fail cost 13 in the paper; 10,000 would drown all else."""
    client = edge()
    losses = []
    for mission, cost in (("forged", 10_000), ("worst", 13)):
        decision = client.post("/decide", json=report(mission_id=mission)).json()
        outcome = {"decision_id": decision["decision_id"], "cost": cost}
        client.post("/decide", json=report(mission_id=mission, step=1, outcome=outcome))
        until(partial(updates_of, client, mission))
        losses.append(client.get(f"/missions/{mission}").json()["learner_loss"])
    assert losses[0] == pytest.approx(losses[1])
    assert "aicvds_costs_clipped_total 1.0" in client.get("/metrics").text


def test_only_the_uav_that_flew_a_decision_knows_its_outcome(edge: Edge, report: Report) -> None:
    client = edge()
    decision = client.post("/decide", json=report()).json()
    outcome = {"decision_id": decision["decision_id"], "cost": 0.0}
    refused = client.post("/decide", json=report(uav_id=1, outcome=outcome))
    assert refused.status_code == 422
    assert fields(refused) == ["outcome.decision_id"]
    assert client.post("/decide", json=report(step=1, outcome=outcome)).status_code == 200
    assert client.get("/missions/test").json()["feedback"] == 1


def test_of_many_missions_two_hundred_are_listed_and_the_rest_counted_and_none_has_decided(edge: Edge) -> None:
    client = edge()
    for number in range(203):
        assert client.put(f"/missions/m{number}", json={"mode": "policy"}).status_code == 200
    listed = client.get("/missions").json()
    assert [line["mission_id"] for line in listed["missions"]] == [f"m{number}" for number in range(202, 2, -1)]
    assert (listed["more"], listed["newest"]) == (3, None)
