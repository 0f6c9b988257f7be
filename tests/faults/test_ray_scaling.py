"""Edges on Ray that are added and ended by load, and a cluster whose head node is lost: nothing acknowledged is."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from service.cluster.ingress import ingress_application
from service.config.settings import Settings
from shared.kit.ray_connection import LOCAL, connected
from tests.faults.fleet import Report
from tests.faults.shared_fleet import LEASE_S, flying
from tests.faults.test_ray import command, ingress, replicas, settings, two_raylets
from tests.support.processes import output_until, started
from tests.support.running import serving
from tests.support.running_edges import drain_output
from tests.support.shared_store import DEADLINE_MS, Database
from tests.support.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.faults, pytest.mark.timeout(600)]

NAMES = [f"slow{number}" for number in range(8)]


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    shared = Database(tmp_path / "postgres")
    yield shared
    shared.close()


def samples(client: httpx.Client, name: str) -> list[float]:
    """A metric's value for each edge."""
    text = client.get("/metrics").text
    return [float(line.split()[-1]) for line in text.splitlines() if line.startswith(f"{name}{{")]


def decided(client: httpx.Client, body: dict[str, Any]) -> int:
    """Decide, and report the outcome; each request is sent again while it is refused. Returns the refusals."""
    refused = 0
    headers = {"Idempotency-Key": uuid.uuid4().hex}
    outcome: dict[str, Any] = {"mission_id": body["mission_id"], "cost": 0.25}
    for path in ("/decide", "/feedback"):
        sent = body if path == "/decide" else outcome
        while (answer := client.post(path, json=sent, headers=headers)).status_code == 503:
            assert "Retry-After" in answer.headers
            refused += 1
            time.sleep(0.2)
        assert answer.status_code == 200, answer.text
        if path == "/decide":
            assert answer.json()["stored"]
            outcome["decision_id"] = answer.json()["decision_id"]
            headers = {}
    return refused


# Ray's own, when Ray Serve is imported.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_an_edge_is_added_under_load_and_ended_without(database: Database, report: Report) -> None:
    with connected(LOCAL, 2):
        # Ray reads its settings when it is imported.
        from service.cluster.replicas import deployed, ended

        scaling = {"target_ongoing_requests": 1.0, "upscale_delay_s": 2.0, "downscale_delay_s": 6.0}
        own = Settings(
            store=database.url,
            mode="value",
            planner="off",
            lease_s=LEASE_S,
            deadline_ms=DEADLINE_MS,
        )
        owners = deployed(own, "127.0.0.1", 1, 2, **scaling)
        app = ingress_application(own, owners, ended)
        with serving(app) as url, httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            until(lambda: client.get("/readyz").status_code == 200)
            assert len(samples(client, "aicvds_missions")) == 1
            with flying(url, report) as trial:
                until(lambda: len(samples(client, "aicvds_missions")) == 2, lambda: trial.fleet[0].answers)
                trial.goes_on()
                # New missions are for both.
                rounds = 0
                while min(samples(client, "aicvds_leases")) == 0 or not rounds:
                    for name in NAMES:
                        decided(client, report(mission_id=name, step=rounds))
                    rounds += 1
                    assert rounds < 20
            owned = samples(client, "aicvds_leases")
            assert len(owned) == 2 and min(owned) > 0
            # A UAV now and then is no load.
            while len(samples(client, "aicvds_missions")) == 2:
                for name in NAMES:
                    decided(client, report(mission_id=name, step=rounds))
                    time.sleep(0.2)
                rounds += 1
                assert rounds < 60
            for name in NAMES:
                decided(client, report(mission_id=name, step=rounds))
            rounds += 1
            for name in NAMES:
                status = client.get(f"/missions/{name}").json()
                assert (status["decisions"], status["feedback"]) == (rounds, rounds)
            until(lambda: len(samples(client, "aicvds_leases")) == 1)

            def owns_all() -> bool:
                # The other edge may decide some while it ends, and a mission is taken over with its next request.
                for name in NAMES:
                    decided(client, report(mission_id=name, step=rounds))
                # The edge counts its leases when it renews them.
                return samples(client, "aicvds_leases")[0] >= len(NAMES)

            until(owns_all)


def test_a_cluster_that_loses_its_head_node_loses_nothing_acknowledged(database: Database, report: Report) -> None:
    with (
        two_raylets() as (cluster, _),
        started(*command(cluster.address), **settings(database)) as process,
        httpx.Client(timeout=PATIENCE_S) as client,
    ):
        client.base_url = httpx.URL(output_until(process, r"listening on (http://[\d.:]+)")[1])
        drain_output(process)
        until(lambda: client.get("/readyz").status_code == 200)
        for name in NAMES:
            assert not decided(client, report(mission_id=name))
        edges = replicas(psutil.Process())
        assert len(edges) == 2
        began = time.monotonic()
        cluster.head_node.kill_gcs_server()
        cluster.head_node.kill_raylet()
        # Without the head node there is no cluster: the edges and the ingress end by themselves.
        process.wait(4 * PATIENCE_S)
        _, alive = psutil.wait_procs(edges, 4 * PATIENCE_S)
        print(f"ended {time.monotonic() - began:.1f} s after the head node", process.returncode, alive)
        assert not alive
    with ingress(database, LOCAL) as url, httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        for name in NAMES:
            decided(client, report(mission_id=name, step=1))
            status = client.get(f"/missions/{name}").json()
            assert (status["decisions"], status["feedback"]) == (2, 2)
