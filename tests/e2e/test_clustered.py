"""``aicvds serve --ray``: edges on a real Ray behind their ingress, with keys; their missions go on without Ray."""

from __future__ import annotations

import signal
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.support.processes import output_until, run_here, started
from tests.support.running_edges import Report, drain_output, first_event
from tests.support.shared_store import Database
from tests.support.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("made_on_decide")]

NAMES = ("one", "two", "three")


@pytest.fixture
def settings(tmp_path: Path) -> Iterator[dict[str, str]]:
    database = Database(tmp_path / "postgres")
    keys = str(tmp_path / "keys.json")
    try:
        yield {"AICVDS_STORE": database.url, "AICVDS_KEYS": keys, "AICVDS_MODE": "value", "AICVDS_PLANNER": "off"}
    finally:
        database.close()


@contextmanager
def serving(settings: dict[str, str], *args: str) -> Iterator[httpx.Client]:
    """A client of the ready edge; it must end when asked to."""
    key = run_here(
        "keys", "add", "-".join(("k", *args)), "--file", settings["AICVDS_KEYS"], "--scopes", "decide", "admin"
    )
    with started("serve", "--port", "0", *args, **settings) as process:
        url = output_until(process, r"listening on (http://[\d.:]+)")[1]
        drain_output(process)
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            until(lambda: client.get("/readyz").status_code == 200)
            assert client.post("/decide", json={"step": 0}).status_code == 401
            assert client.get("/missions").status_code == client.get("/metrics").status_code == 401
            client.headers["Authorization"] = f"Bearer {key.stdout.strip()}"
            yield client
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


def leases(client: httpx.Client) -> tuple[int, float]:
    """How many edges there are, and how many missions they own together."""
    samples = [line for line in client.get("/metrics").text.splitlines() if line.startswith("aicvds_leases{")]
    return len(samples), sum(float(line.split()[-1]) for line in samples)


def test_edges_on_ray_answer_as_one_and_their_missions_go_on_without_it(
    settings: dict[str, str], report: Report
) -> None:
    with serving(settings, "--ray", "local", "--replicas", "2") as client:
        decided = {}
        for name in NAMES:
            answer = client.post("/decide", json=report(mission_id=name)).raise_for_status().json()
            assert answer["stored"]
            decided[name] = answer["decision_id"]
            # Nobody says whose decision it is.
            outcome = {"decision_id": answer["decision_id"], "cost": 0.5}
            assert client.post("/feedback", json=outcome).json()["result"] == "applied"
            assert client.post("/feedback", json={**outcome, "mission_id": name}).json()["result"] == "duplicate"
            assert name in first_event(client, name)
        assert client.post("/feedback", json={"decision_id": uuid.uuid4().hex, "cost": 0.5}).status_code == 404
        listed = client.get("/missions").json()
        assert {line["mission_id"]: line["decisions"] for line in listed["missions"]} == dict.fromkeys(NAMES, 1)
        assert listed["newest"] == NAMES[-1] and listed["may_command"]
        until(lambda: leases(client) == (2, len(NAMES)))
        assert client.delete(f"/missions/{NAMES[0]}").status_code == 204
    # The leases were given up, so nothing has to wait for their end.
    with serving(settings) as client:
        assert client.get(f"/missions/{NAMES[0]}").status_code == 404
        for name in NAMES[1:]:
            assert client.get(f"/missions/{name}").json()["feedback"] == 1
            assert client.post("/decide", json=report(mission_id=name, step=1)).json()["stored"]
