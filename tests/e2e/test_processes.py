"""``aicvds serve --processes 2``: one port, and each mission decided by its own process."""

from __future__ import annotations

import json
import os
import signal
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from service.config.processes import slot_of
from service.storage.locks import FileLock, StoreUnusable
from tests.e2e.processes import output_until, run, run_here, started
from tests.service.stub_llm import wait_for
from tests.waiting import PATIENCE_S, until

Report = Callable[..., dict[str, Any]]
# Two missions for each of two processes.
NAMES = [next(n for n in (f"m{slot}{i}" for i in range(99)) if slot_of(n, 2) == slot) for slot in (0, 1)]
OTHERS = [next(n for n in (f"o{slot}{i}" for i in range(99)) if slot_of(n, 2) == slot) for slot in (0, 1)]


class Processes:
    """A running edge: its parent, its URL, and its deciding processes by slot."""

    def __init__(self, url: str, parent: psutil.Process) -> None:
        self.url, self.parent = url, parent

    def deciding(self) -> dict[int, psutil.Process]:
        """The deciding processes by slot: each answers the others' requests at a socket named by its slot."""
        return {slot: child for child in self.parent.children() if (slot := _slot(child)) is not None}

    def ready(self) -> bool:
        """Whether all are."""
        return httpx.get(f"{self.url}/readyz", timeout=PATIENCE_S).status_code == 200


def _sockets(process: psutil.Process) -> list[Path]:
    try:
        return [Path(str(c.laddr)) for c in process.net_connections("unix")]
    except psutil.Error:
        return []


def _slot(process: psutil.Process) -> int | None:
    return next((int(path.stem) for path in _sockets(process) if path.suffix == ".moved"), None)


@contextmanager
def _serving(store: Path | str, processes: int = 2, **env: str) -> Iterator[Processes]:
    settings = {"AICVDS_STORE": str(store), "AICVDS_MODE": "value", "AICVDS_PLANNER": "off", **env}
    settings |= {"AICVDS_DEADLINE_MS": "60000"}
    with started("serve", "--port", "0", "--processes", str(processes), **settings) as process:
        url = output_until(process, r"listening on (http://[\d.:]+)")[1]
        edge = Processes(url, psutil.Process(process.pid))
        # Nobody reads it from here on.
        assert process.stdout is not None
        threading.Thread(target=process.stdout.read, daemon=True).start()
        until(edge.ready)
        yield edge
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) in (0, -signal.SIGTERM)


def _events(url: str, mission: str) -> str:
    """The first event of a mission's stream."""
    with (
        httpx.Client(timeout=PATIENCE_S) as client,
        client.stream("GET", f"{url}/missions/{mission}/events") as stream,
    ):
        assert stream.status_code == 200
        return next(line for line in stream.iter_lines() if line.startswith("data:"))


def test_every_mission_is_decided_by_its_own_process(tmp_path: Path, report: Report) -> None:
    with _serving(tmp_path / "m.db") as edge, httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client:
        assert "libtorch" not in Path(f"/proc/{edge.parent.pid}/maps").read_text()
        decided: dict[str, list[str]] = {name: [] for name in NAMES}
        # One connection for both missions, back and forth.
        for step in range(3):
            for name in NAMES:
                answer = client.post("/decide", json=report(mission_id=name, step=step)).raise_for_status().json()
                assert answer["stored"]
                decided[name].append(answer["decision_id"])
        # Where the first glance at a request names the wrong mission, it moves once more.
        for first, last in (NAMES, NAMES[::-1]):
            twice = json.dumps(report(mission_id=last, step=2, uav_id=1)).replace("{", f'{{"mission_id": "{first}",', 1)
            answer = client.post("/decide", content=twice, headers={"Content-Type": "application/json"})
            assert answer.json()["mission_id"] == last
        for name in NAMES:
            outcome = {"decision_id": decided[name][0], "cost": 0.5}
            assert client.post("/feedback", json={**outcome, "mission_id": name}).json()["result"] == "applied"
            # The process that knows the decision answers, whichever is asked.
            assert client.post("/feedback", json=outcome).json()["result"] == "duplicate"
            assert client.get(f"/missions/{name}").json()["decisions"] == 4
            assert client.get(f"/missions/{name}/decisions/{decided[name][2]}/prompt").json()["state"]
            assert name in _events(edge.url, name)
        assert client.post("/feedback", json={"decision_id": uuid.uuid4().hex, "cost": 0.5}).status_code == 404
        listed = client.get("/missions").json()
        assert {line["mission_id"]: line["decisions"] for line in listed["missions"]} == dict.fromkeys(NAMES, 4)
        assert listed["newest"] == NAMES[0] and listed["more"] == 0
        metrics = client.get("/metrics").text
        for process in "01":
            assert f'aicvds_missions{{process="{process}"}} 1.0' in metrics
            assert f'aicvds_decisions_total{{process="{process}",reason="mode_value",source="value"}} 4.0' in metrics
        assert client.delete(f"/missions/{NAMES[0]}").status_code == 204
        assert client.get(f"/missions/{NAMES[0]}").status_code == 404
        assert set(edge.deciding()) == {0, 1}
        children = edge.parent.children(recursive=True)
        folder = next(path.parent for path in _sockets(edge.deciding()[0]) if path.suffix == ".moved")
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not psutil.wait_procs(children, PATIENCE_S)[1]
    assert not folder.exists()


class Uav(threading.Thread):
    """Decides and reports outcomes; counts those that were acknowledged."""

    def __init__(self, url: str, mission: str, report: Report) -> None:
        super().__init__(daemon=True)
        self.mission, self._url, self._report = mission, url, report
        self.acknowledged, self.refused, self.over = 0, 0, False
        self.wrong = ""

    def run(self) -> None:
        try:
            with httpx.Client(base_url=self._url, timeout=PATIENCE_S) as client:
                step = 0
                while not self.over:
                    body = self._report(mission_id=self.mission, step=step)
                    answer = self._acknowledged(client, "/decide", body)
                    if answer.json()["stored"]:
                        outcome = {"decision_id": answer.json()["decision_id"], "cost": 0.25}
                        self._acknowledged(client, "/feedback", {**outcome, "mission_id": self.mission})
                        self.acknowledged += 1
                    step += 1
        except (AssertionError, httpx.HTTPError) as error:
            self.wrong = repr(error)

    def _acknowledged(self, client: httpx.Client, path: str, body: dict[str, Any]) -> httpx.Response:
        headers = {"Idempotency-Key": uuid.uuid4().hex} if path == "/decide" else {}
        while True:
            try:
                answer = client.post(path, json=body, headers=headers)
            except httpx.TransportError:
                # The connection ended with its process.
                continue
            if answer.status_code == 200:
                return answer
            assert answer.status_code == 503 and answer.headers["Retry-After"], answer.text
            self.refused += 1


@pytest.mark.long
def test_a_killed_process_loses_nothing_and_the_others_go_on(tmp_path: Path, report: Report) -> None:
    with _serving(tmp_path / "m.db") as edge:
        fleet = [Uav(edge.url, name, report) for name in (*NAMES, *OTHERS)]
        for uav in fleet:
            uav.start()
        until(lambda: all(uav.acknowledged > 3 for uav in fleet))
        victim = edge.deciding()[1]
        os.kill(victim.pid, signal.SIGKILL)
        others = [uav for uav in fleet if slot_of(uav.mission, 2) == 0]
        hit = [uav for uav in fleet if slot_of(uav.mission, 2) == 1]
        before = {uav.mission: uav.acknowledged for uav in fleet}
        until(lambda: all(uav.acknowledged > before[uav.mission] + 5 for uav in others))
        until(lambda: all(uav.acknowledged > before[uav.mission] + 5 for uav in hit), lambda: [u.wrong for u in fleet])
        for uav in fleet:
            uav.over = True
        for uav in fleet:
            uav.join(PATIENCE_S)
        assert [uav.wrong for uav in fleet] == [""] * len(fleet)
        assert edge.deciding()[1].pid != victim.pid
        # The missions of the process that was killed were refused meanwhile, and no other's.
        assert any(uav.refused for uav in hit) and not any(uav.refused for uav in others)
        for uav in fleet:
            status = httpx.get(f"{edge.url}/missions/{uav.mission}", timeout=PATIENCE_S).json()
            assert status["feedback"] == uav.acknowledged


@pytest.mark.long
def test_all_have_one_embedded_llm_and_outlive_it(tmp_path: Path, report: Report) -> None:
    with (
        _serving("none", AICVDS_MODE="llm", AICVDS_LLM_ADAPTER="off") as edge,
        httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client,
    ):
        wait_for(client, "ready")

        def reasons(step: int) -> list[str | None]:
            return [client.post("/decide", json=report(mission_id=n, step=step)).json()["reason"] for n in NAMES]

        away = {"llm_loading", "llm_unavailable", "llm_timeout"}
        assert not away & set(reasons(0))
        deciding = {child.pid for child in edge.deciding().values()}
        (llm,) = (child for child in edge.parent.children() if child.pid not in deciding)
        llm.kill()
        # The first calls end with the connection that they find.
        until(lambda: reasons(1) == ["llm_unavailable"] * 2)
        wait_for(client, "ready")
        assert not away & set(reasons(2))


@pytest.mark.long
def test_missions_go_on_in_one_process_after_the_parent_was_killed(tmp_path: Path, report: Report) -> None:
    """With keys, which hold for every process."""
    store, keys = tmp_path / "m.db", str(tmp_path / "keys.json")
    key = run_here("keys", "add", "fleet", "--file", keys, "--scopes", "decide", "admin").stdout.strip()
    env = {"AICVDS_STORE": str(store), "AICVDS_KEYS": keys, "AICVDS_MODE": "value", "AICVDS_DEADLINE_MS": "60000"}
    with (
        started("serve", "--port", "0", AICVDS_PROCESSES="2", **env) as process,
        httpx.Client(timeout=PATIENCE_S) as client,
    ):
        client.base_url = httpx.URL(output_until(process, r"listening on (http://[\d.:]+)")[1])
        until(lambda: client.get("/readyz").status_code == 200)
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name)).status_code == 401
        client.headers["Authorization"] = f"Bearer {key}"
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name)).json()["stored"]
        assert client.get("/metrics").text.count("aicvds_missions{") == 2
        listed = client.get("/missions").json()
        assert len(listed["missions"]) == 2 and listed["may_command"]
        with pytest.raises(StoreUnusable, match="another edge"):
            FileLock(str(store))
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        assert not psutil.wait_procs(children, PATIENCE_S)[1]
    with _serving(store, 1) as edge, httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client:
        listed = client.get("/missions").json()
        assert {line["mission_id"] for line in listed["missions"]} == set(NAMES)
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name, step=1)).status_code == 200
            assert client.get(f"/missions/{name}").json()["decisions"] == 2


@pytest.mark.parametrize("processes", ["0", "65", "two"])
def test_a_number_of_processes_that_cannot_be_is_refused(processes: str) -> None:
    refused = run("serve", "--port", "0", "--processes", processes)
    assert refused.returncode == 2
    assert "processes" in (refused.stderr + refused.stdout).lower()
    assert json.dumps(refused.stderr).count("Traceback") == 0
