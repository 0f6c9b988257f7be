"""Two edges on Ray: replicas killed under load, and one of two raylets on this machine."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from tests.faults.fleet import Report
from tests.faults.shared_fleet import LEASE_S, flying
from tests.faults.table import Tables
from tests.support.processes import output_until, run, started
from tests.support.running_edges import drain_output
from tests.support.shared_store import DEADLINE_MS, Database
from tests.support.waiting import PATIENCE_S, until

pytestmark = [pytest.mark.faults, pytest.mark.timeout(900)]

KILLS, LOST_RAYLETS = 5, 3
MACHINE: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 100_000_000}
# The longest wait for a mission's next decision, from the end of its lease.
MOST_S = 8.0
TITLE = "Two edges on Ray, and their ingress"


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    shared = Database(tmp_path / "postgres")
    yield shared
    shared.close()


def settings(database: Database) -> dict[str, str]:
    """Of every ingress."""
    return {
        "AICVDS_STORE": database.url,
        "AICVDS_LEASE_S": str(LEASE_S),
        "AICVDS_MODE": "value",
        "AICVDS_PLANNER": "off",
        "AICVDS_DEADLINE_MS": str(DEADLINE_MS),
        "AICVDS_ANONYMOUS": "on",
    }


def command(ray: str) -> list[str]:
    """An ingress with two edges there."""
    return ["serve", "--port", "0", "--ray", ray, "--replicas", "2"]


@contextmanager
def ingress(database: Database, ray: str) -> Iterator[str]:
    """``aicvds serve --ray`` with two edges, ready; it must end when asked to."""
    with started(*command(ray), **settings(database)) as process:
        url = output_until(process, r"listening on (http://[\d.:]+)")[1]
        drain_output(process)
        until(lambda: both_ready(url))
        yield url
        process.terminate()
        assert process.wait(PATIENCE_S) in (0, -15)


def both_ready(url: str) -> bool:
    """Whether the ingress has two edges that can decide."""
    if httpx.get(f"{url}/readyz", timeout=PATIENCE_S).status_code != 200:
        return False
    metrics = httpx.get(f"{url}/metrics", timeout=PATIENCE_S)
    return metrics.status_code == 200 and metrics.text.count("\naicvds_missions{") == 2


@contextmanager
def two_raylets() -> Iterator[tuple[Any, Any]]:
    """A cluster, and its second node; this machine is two of one core each."""
    # Ray reads its token when it is imported.
    assert os.environ["RAY_AUTH_TOKEN"]
    from ray.cluster_utils import Cluster

    cluster: Any = Cluster(initialize_head=True, head_node_args={**MACHINE, "include_dashboard": False})
    try:
        yield cluster, cluster.add_node(**MACHINE)
    finally:
        cluster.shutdown()


def replicas(above: psutil.Process) -> list[psutil.Process]:
    """The edges among a process's descendants."""
    found = []
    for process in above.children(recursive=True):
        try:
            if process.name().startswith("ray::ServeRepl"):
                found.append(process)
        except psutil.NoSuchProcess:
            continue
    return found


def test_replicas_are_killed(database: Database, report: Report, tables: Tables) -> None:
    chance = random.Random(6)
    with ingress(database, "local") as url, flying(url, report) as trial:
        for _ in range(KILLS):
            time.sleep(chance.uniform(0.1, 0.6))
            chance.choice(replicas(psutil.Process())).kill()
            trial.goes_on()
            until(lambda: both_ready(url))
        trial.finish(tables, TITLE, "a replica is killed (kill -9)", KILLS)
    assert max(trial.gaps_s) < LEASE_S + MOST_S


def test_a_raylet_is_killed(database: Database, report: Report, tables: Tables) -> None:
    """As if one of two machines were lost; the ingress is on the other."""
    with two_raylets() as (cluster, node), ingress(database, cluster.address) as url, flying(url, report) as trial:
        for _ in range(LOST_RAYLETS):
            time.sleep(0.5)
            raylet = psutil.Process(node.all_processes["raylet"][0].process.pid)
            lost = replicas(raylet)
            assert lost
            node.kill_raylet()
            # Without it they would end by themselves, in order, some two seconds later.
            for edge in lost:
                edge.kill()
            trial.goes_on()
            node = cluster.add_node(**MACHINE)
            until(lambda: both_ready(url))
        trial.finish(tables, TITLE, "one of two raylets is killed, with its edge (kill -9)", LOST_RAYLETS)
    assert max(trial.gaps_s) < LEASE_S + MOST_S


def test_several_ingresses_use_the_same_edges_which_outlive_them(database: Database, report: Report) -> None:
    with two_raylets() as (cluster, _):
        with started(*command(cluster.address), **settings(database)) as first:
            url = output_until(first, r"listening on (http://[\d.:]+)")[1]
            drain_output(first)
            until(lambda: both_ready(url))
            edges = {edge.pid for edge in replicas(psutil.Process())}
            assert httpx.post(f"{url}/decide", json=report(step=0), timeout=PATIENCE_S).json()["stored"]
            other = run(*command(cluster.address), **settings(database), AICVDS_TOP_K="3")
            assert other.returncode == 2 and "edges with other settings" in other.stderr
            # The end of the block kills it.
        for step in (1, 2):
            with ingress(database, cluster.address) as url:
                assert httpx.post(f"{url}/decide", json=report(step=step), timeout=PATIENCE_S).json()["stored"]
                assert httpx.get(f"{url}/missions/test", timeout=PATIENCE_S).json()["decisions"] == step + 1
        assert {edge.pid for edge in replicas(psutil.Process())} == edges and len(edges) == 2
