"""A running ``aicvds serve --processes N``, and UAVs that fly while one of its processes is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import psutil

from service.config.process_member import slot_of
from tests.e2e.processes import output_until, started
from tests.support.waiting import PATIENCE_S, until

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


def sockets(process: psutil.Process) -> list[Path]:
    """Paths of the Unix sockets at which a process listens."""
    try:
        return [Path(str(c.laddr)) for c in process.net_connections("unix")]
    except psutil.Error:
        return []


def _slot(process: psutil.Process) -> int | None:
    return next((int(path.stem) for path in sockets(process) if path.suffix == ".moved"), None)


def drained(process: subprocess.Popen[str]) -> None:
    """Let nothing wait for a reader of its output from here on."""
    assert process.stdout is not None
    threading.Thread(target=process.stdout.read, daemon=True).start()


def first_event(client: httpx.Client, mission: str) -> str:
    """The first event of a mission's stream."""
    with client.stream("GET", f"/missions/{mission}/events") as stream:
        assert stream.status_code == 200
        return next(line for line in stream.iter_lines() if line.startswith("data:"))


@contextmanager
def serving(store: Path | str, processes: int = 2, **env: str) -> Iterator[Processes]:
    """So many deciding processes, ready; they must end when asked to."""
    settings = {"AICVDS_STORE": str(store), "AICVDS_MODE": "value", "AICVDS_PLANNER": "off", **env}
    settings |= {"AICVDS_DEADLINE_MS": "60000"}
    with started("serve", "--port", "0", "--processes", str(processes), **settings) as process:
        url = output_until(process, r"listening on (http://[\d.:]+)")[1]
        edge = Processes(url, psutil.Process(process.pid))
        drained(process)
        until(edge.ready)
        yield edge
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) in (0, -signal.SIGTERM)


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


def outlive_a_kill(edge: Processes, report: Report) -> None:
    """Kill one of two processes under load: nothing acknowledged is lost, and the other's missions go on meanwhile."""
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
