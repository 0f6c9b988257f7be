"""Missions that report and ask over connections which wait for each answer, at full speed or at a pace."""

from __future__ import annotations

import http.client
import json
import random
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.harness import Server
from benchmarks.load import SENSORS, heard
from simulator.flying.local_edge import HOST

UAVS = 3


@dataclass
class Flown:
    """A mission's progress in its flight: its next decision, and each UAV's unreported outcome."""

    name: str
    told: int = 0
    owed: dict[int, dict[str, Any]] = field(default_factory=dict)
    turn: threading.Lock = field(default_factory=threading.Lock)

    @property
    def uav(self) -> int:
        """The UAV of the next decision."""
        return self.told % UAVS

    @property
    def step(self) -> int:
        """The step of the next decision."""
        return self.told // UAVS


class Radio:
    """One connection to the edge."""

    def __init__(self, edge: Server, seed: int) -> None:
        self._http = http.client.HTTPConnection(HOST, edge.port, timeout=60)
        self._random = random.Random(seed)

    def made(self, name: str, mode: str = "value") -> Flown:
        """A new mission."""
        self.post(f"/missions/{name}", {"mode": mode}, "PUT")
        return Flown(name)

    def decide(self, mission: Flown, learn: bool) -> float:
        """Ask for the mission's next decision; returns the milliseconds from the request to the answer."""
        with mission.turn:
            uav = mission.uav
            outcome = mission.owed.pop(uav, None) if learn else None
            body = {**self._state(mission, uav), "mission_id": mission.name, "step": mission.step, "outcome": outcome}
            answer, took_ms = self.post("/decide", body)
            self._told(mission, answer)
        return took_ms

    def step(self, mission: Flown, attempts: int = 1) -> list[dict[str, Any]]:
        """Ask for the mission's next three decisions in one batch, which is sent so many times."""
        states = [{**self._state(mission, uav), "outcome": mission.owed.pop(uav, None)} for uav in range(UAVS)]
        body = {"mission_id": mission.name, "step": mission.step, "uavs": states}
        answer, _ = self.post("/decide/batch", body, attempts=attempts)
        for one in answer["decisions"]:
            self._told(mission, one)
        return list(answer["decisions"])

    def post(
        self, path: str, body: dict[str, Any], method: str = "POST", attempts: int = 1
    ) -> tuple[dict[str, Any], float]:
        """The last attempt's answer and its milliseconds; raises ``SystemExit`` where the edge refuses."""
        content = json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        # The UAVs of `aicvds simulate` do the same.
        headers |= {"Idempotency-Key": uuid.uuid4().hex} if path.startswith("/decide") else {}
        for _ in range(attempts):
            try:
                response, data, took_ms = self._ask(method, path, content, headers)
            except (ConnectionError, http.client.RemoteDisconnected):
                # The edge closes idle connections after seconds; the key makes the second attempt the same request.
                self._http.close()
                response, data, took_ms = self._ask(method, path, content, headers)
            if response.status >= 300:
                raise SystemExit(f"{path} answered {response.status}: {data[:300]!r}")
        return (json.loads(data) if data else {}), took_ms

    def _ask(
        self, method: str, path: str, content: bytes, headers: dict[str, str]
    ) -> tuple[http.client.HTTPResponse, bytes, float]:
        began = time.perf_counter()
        self._http.request(method, path, content, headers)
        response = self._http.getresponse()
        data = response.read()
        return response, data, (time.perf_counter() - began) * 1e3

    def _state(self, mission: Flown, uav: int) -> dict[str, Any]:
        queues = [self._random.randrange(60) for _ in range(SENSORS)]
        return {"uav_id": uav, "position": [500.0 + 10 * uav, 450.0], "sensors": heard(mission.step, queues)}

    def _told(self, mission: Flown, answer: dict[str, Any]) -> None:
        cost = self._random.random()
        mission.owed[answer["uav_id"]] = {"decision_id": answer["decision_id"], "cost": cost, "failed": cost > 0.8}
        mission.told += 1


def at_once(radios: Sequence[Radio], work: Sequence[Callable[[Radio], float | None]]) -> list[float]:
    """Do all of the work, each radio one job after the other; returns the results."""
    waiting, found, faults = iter(work), list[float](), list[BaseException]()
    lock = threading.Lock()

    def fly(radio: Radio) -> None:
        try:
            while True:
                with lock:
                    task = next(waiting, None)
                if task is None or faults:
                    return
                if (took := task(radio)) is not None:
                    found.append(took)
        except BaseException as fault:
            faults.append(fault)

    threads = [threading.Thread(target=fly, args=(radio,), daemon=True) for radio in radios]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if faults:
        raise faults[0]
    return found


def paced(radios: Sequence[Radio], missions: Sequence[Flown], count: int, pace: float, learn: bool) -> list[float]:
    """Start decisions at even intervals, without waiting for earlier answers while a radio is free."""
    began = time.perf_counter()

    def at(index: int) -> Callable[[Radio], float]:
        def decide(radio: Radio) -> float:
            time.sleep(max(0.0, began + index / pace - time.perf_counter()))
            return radio.decide(missions[index % len(missions)], learn)

        return decide

    return at_once(radios, [at(index) for index in range(count)])
