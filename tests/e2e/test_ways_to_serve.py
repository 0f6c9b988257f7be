"""One edge, and edges on Ray: each serves a PostgreSQL store alike, and what it acknowledged outlives it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil
import psycopg
import pytest

from tests.support.processes import output_until, started
from tests.support.running_edges import Report, drain_output
from tests.support.shared_store import Database
from tests.support.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]

WAYS = {"plain": (), "ray": ("--ray", "local", "--replicas", "2")}
NAMES = tuple(f"mission{number}" for number in range(4))
ENDED = "ended"
# Fields of a mission that depend on the time of day.
CLOCKED = {"created_at"}
SETTINGS = {
    "AICVDS_MODE": "value",
    "AICVDS_PLANNER": "off",
    "AICVDS_LEASE_S": "2",
    "AICVDS_DEADLINE_MS": "3000",
    "AICVDS_LLM_URL": "http://127.0.0.1:9/v1",
}


@contextmanager
def serving(store: str, *way: str) -> Iterator[httpx.Client]:
    """A client of the ready edge, which is killed at the end with all its processes."""
    with started("serve", "--port", "0", *way, AICVDS_STORE=store, **SETTINGS) as process:
        url = output_until(process, r"listening on (http://[\d.:]+)")[1]
        drain_output(process)
        with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            until(lambda: client.get("/readyz").status_code == 200)
            yield client
        all_of_it = [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]
        for each in all_of_it:
            each.kill()
        psutil.wait_procs(all_of_it, PATIENCE_S)


def posted(client: httpx.Client, path: str, body: dict[str, Any], key: str | None = None) -> dict[str, Any]:
    """The answer; a request that is refused with Retry-After is sent again."""
    answers: list[httpx.Response] = []

    def answered() -> bool:
        answer = client.post(path, json=body, headers={} if key is None else {"Idempotency-Key": key})
        # 421: the lease of a process that was killed has not ended.
        assert answer.status_code == 200 or (answer.status_code in (421, 503) and "Retry-After" in answer.headers)
        answers.append(answer)
        return answer.status_code == 200

    until(answered)
    found: dict[str, Any] = answers[-1].json()
    return found


def chosen(decision: dict[str, Any]) -> tuple[Any, ...]:
    """What two edges that know the same decide alike."""
    return decision["sensor_id"], decision["velocity"], decision["source"], decision["reason"]


def status(client: httpx.Client, name: str) -> dict[str, Any]:
    """What does not depend on the time of day."""
    found: dict[str, Any] = client.get(f"/missions/{name}").raise_for_status().json()
    return {field: value for field, value in found.items() if field not in CLOCKED}


def served(way: tuple[str, ...], folder: Path, report: Report) -> list[Any]:
    """Fly missions in that way, kill everything, go on in one process; what was decided."""
    database = Database(folder)
    found: list[Any] = []
    try:
        with serving(database.url, *way) as client:
            keys: dict[str, str] = {}
            for name in (*NAMES, ENDED):
                client.put(f"/missions/{name}", json={"mode": "value", "top_k": 3}).raise_for_status()
            orders = {"guidance": {"sensors": [{"sensor_id": 1, "weight": 2.0}], "max_velocity": 10}}
            client.post(f"/missions/{NAMES[0]}/guidance", json=orders).raise_for_status()
            for step in range(12):
                for name in (*NAMES, ENDED):
                    decision = posted(client, "/decide", report(mission_id=name, step=step), f"{name}-{step}")
                    assert decision["stored"]
                    keys[name] = decision["decision_id"]
                    found.append(chosen(decision))
                    outcome = {"mission_id": name, "decision_id": decision["decision_id"], "cost": step % 5 / 4}
                    assert posted(client, "/feedback", outcome)["result"] == "applied"
            assert client.delete(f"/missions/{ENDED}").status_code == 204
            # Decisions go on while the store is locked, and no outcome is acknowledged.
            with psycopg.connect(database.url) as lock:
                lock.execute("LOCK TABLE journal IN ACCESS EXCLUSIVE MODE")
                unstored = client.post("/decide", json=report(mission_id=NAMES[0], step=12)).raise_for_status().json()
                assert not unstored["stored"]
                outcome = {"mission_id": NAMES[0], "decision_id": unstored["decision_id"], "cost": 0.5}
                refused = client.post("/feedback", json=outcome)
                assert refused.status_code == 503 and "Retry-After" in refused.headers
            assert posted(client, "/feedback", outcome)["result"] in ("applied", "duplicate")
            before = {name: status(client, name) for name in NAMES}
        with serving(database.url) as client:
            for name in NAMES:
                last = posted(client, "/decide", report(mission_id=name, step=11), f"{name}-11")
                assert last["decision_id"] == keys[name], "the same request was decided twice"
                assert status(client, name) == before[name]
                found.append(
                    (status(client, name), chosen(posted(client, "/decide", report(mission_id=name, step=13))))
                )
            assert client.get(f"/missions/{ENDED}").status_code == 404
    finally:
        database.close()
    return found


def test_each_way_to_serve_decides_alike_and_loses_nothing_when_killed(tmp_path: Path, report: Report) -> None:
    plain = served(WAYS["plain"], tmp_path / "plain", report)
    assert served(WAYS["ray"], tmp_path / "ray", report) == plain
