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
from tests.e2e.processes import output_until, run, started
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
        """The process of each slot that has loaded the edge: it has the lock of its place."""
        found = dict[int, psutil.Process]()
        for child in self.parent.children():
            for file in _locks(child):
                found[int(Path(file).stem)] = child
        return found

    def ready(self) -> bool:
        """Whether all are."""
        return httpx.get(f"{self.url}/readyz", timeout=PATIENCE_S).status_code == 200


def _locks(process: psutil.Process) -> list[str]:
    try:
        return [file.path for file in process.open_files() if file.path.endswith(("/0.lock", "/1.lock"))]
    except psutil.Error:
        return []


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
        for name in NAMES:
            outcome = {"decision_id": decided[name][0], "cost": 0.5}
            assert client.post("/feedback", json={**outcome, "mission_id": name}).json()["result"] == "applied"
            # The process that knows the decision answers, whichever is asked.
            assert client.post("/feedback", json=outcome).json()["result"] == "duplicate"
            assert client.get(f"/missions/{name}").json()["decisions"] == 3
            assert client.get(f"/missions/{name}/decisions/{decided[name][2]}/prompt").json()["state"]
            assert name in _events(edge.url, name)
        assert client.post("/feedback", json={"decision_id": uuid.uuid4().hex, "cost": 0.5}).status_code == 404
        listed = client.get("/missions").json()
        assert {line["mission_id"]: line["decisions"] for line in listed["missions"]} == dict.fromkeys(NAMES, 3)
        assert listed["newest"] == NAMES[1] and listed["more"] == 0
        metrics = client.get("/metrics").text
        for process in "01":
            assert f'aicvds_missions{{process="{process}"}} 1.0' in metrics
            assert f'aicvds_decisions_total{{process="{process}",reason="mode_value",source="value"}} 3.0' in metrics
        assert client.delete(f"/missions/{NAMES[0]}").status_code == 204
        assert client.get(f"/missions/{NAMES[0]}").status_code == 404
        assert set(edge.deciding()) == {0, 1}
        children = edge.parent.children(recursive=True)
        folder = Path(next(file for file in map(_locks, children) if file)[0]).parent
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not psutil.wait_procs(children, PATIENCE_S)[1]
    assert not folder.exists()


@pytest.mark.long
def test_missions_go_on_with_another_number_of_processes(tmp_path: Path, report: Report) -> None:
    names = [*NAMES, *OTHERS]
    for run_number, processes in enumerate((2, 1, 3)):
        with _serving(tmp_path / "m.db", processes) as edge:
            with httpx.Client(base_url=edge.url, timeout=PATIENCE_S) as client:
                listed = client.get("/missions").json()["missions"]
                assert {line["mission_id"] for line in listed} == (set(names) if run_number else set())
                for name in names:
                    answer = client.post("/decide", json=report(mission_id=name, step=run_number))
                    assert answer.status_code == 200, answer.text
                    assert client.get(f"/missions/{name}").json()["decisions"] == run_number + 1
            if processes == 2:
                # The file is the processes' own.
                other = run("serve", "--port", "0", AICVDS_STORE=str(tmp_path / "m.db"))
                assert other.returncode == 2 and "another edge uses" in other.stderr


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
def test_keys_hold_for_every_process_and_a_killed_parent_takes_all_along(tmp_path: Path, report: Report) -> None:
    keys = str(tmp_path / "keys.json")
    key = run("keys", "add", "fleet", "--file", keys, "--scopes", "decide", "admin").stdout.strip()
    with (
        started("serve", "--port", "0", "--processes", "2", AICVDS_KEYS=keys, AICVDS_MODE="value") as process,
        httpx.Client(timeout=PATIENCE_S) as client,
    ):
        client.base_url = httpx.URL(output_until(process, r"listening on (http://[\d.:]+)")[1])
        until(lambda: client.get("/readyz").status_code == 200)
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name)).status_code == 401
        client.headers["Authorization"] = f"Bearer {key}"
        for name in NAMES:
            assert client.post("/decide", json=report(mission_id=name)).status_code == 200
        assert client.get("/metrics").text.count("aicvds_missions{") == 2
        listed = client.get("/missions").json()
        assert len(listed["missions"]) == 2 and listed["may_command"]
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        assert not psutil.wait_procs(children, PATIENCE_S)[1]


@pytest.mark.parametrize("processes", ["0", "65", "two"])
def test_a_number_of_processes_that_cannot_be_is_refused(processes: str) -> None:
    refused = run("serve", "--port", "0", "--processes", processes)
    assert refused.returncode == 2
    assert "processes" in (refused.stderr + refused.stdout).lower()
    assert json.dumps(refused.stderr).count("Traceback") == 0
