"""Missions that request decisions over HTTP connections, one request at a time each, at full speed or at a pace."""

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
from benchmarks.load import SENSORS, sensor_columns
from simulator.flying.local_edge import HOST

UAVS = 3


@dataclass
class Flown:
    """A mission's progress in its flight: the number of its decisions, and each UAV's unreported outcome."""

    name: str
    decisions: int = 0
    outcomes: dict[int, dict[str, Any]] = field(default_factory=dict)
    turn: threading.Lock = field(default_factory=threading.Lock)

    @property
    def uav(self) -> int:
        """The UAV of the next decision."""
        return self.decisions % UAVS

    @property
    def step(self) -> int:
        """The step of the next decision."""
        return self.decisions // UAVS


class Radio:
    """One connection to the edge."""

    def __init__(self, edge: Server, seed: int) -> None:
        self._http = http.client.HTTPConnection(HOST, edge.port, timeout=60)
        self._random = random.Random(seed)

    def create(self, name: str, mode: str = "value") -> Flown:
        """Create a mission on the edge."""
        self.post(f"/missions/{name}", {"mode": mode}, "PUT")
        return Flown(name)

    def decide(self, mission: Flown, learn: bool) -> float:
        """Request the mission's next decision; returns the milliseconds from the request to the answer."""
        with mission.turn:
            uav = mission.uav
            outcome = mission.outcomes.pop(uav, None) if learn else None
            body = {**self._state(mission, uav), "mission_id": mission.name, "step": mission.step, "outcome": outcome}
            answer, took_ms = self.post("/decide", body)
            self._record(mission, answer)
        return took_ms

    def step(self, mission: Flown, attempts: int = 1) -> list[dict[str, Any]]:
        """Request the mission's next three decisions in one batch, and send the request ``attempts`` times."""
        states = [{**self._state(mission, uav), "outcome": mission.outcomes.pop(uav, None)} for uav in range(UAVS)]
        body = {"mission_id": mission.name, "step": mission.step, "uavs": states}
        answer, _ = self.post("/decide/batch", body, attempts=attempts)
        for decision in answer["decisions"]:
            self._record(mission, decision)
        return list(answer["decisions"])

    def post(
        self, path: str, body: dict[str, Any], method: str = "POST", attempts: int = 1
    ) -> tuple[dict[str, Any], float]:
        """The last attempt's answer and its milliseconds; raises ``SystemExit`` if the edge refuses the request."""
        content = json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        # The UAVs of `aicvds simulate` do the same.
        headers |= {"Idempotency-Key": uuid.uuid4().hex} if path.startswith("/decide") else {}
        for _ in range(attempts):
            try:
                response, data, took_ms = self._send(method, path, content, headers)
            except (ConnectionError, http.client.RemoteDisconnected):
                # The edge closes idle connections after seconds. With the same key this is the same request.
                self._http.close()
                response, data, took_ms = self._send(method, path, content, headers)
            if response.status >= 300:
                raise SystemExit(f"{path} answered {response.status}: {data[:300]!r}")
        return (json.loads(data) if data else {}), took_ms

    def _send(
        self, method: str, path: str, content: bytes, headers: dict[str, str]
    ) -> tuple[http.client.HTTPResponse, bytes, float]:
        began = time.perf_counter()
        self._http.request(method, path, content, headers)
        response = self._http.getresponse()
        data = response.read()
        return response, data, (time.perf_counter() - began) * 1e3

    def _state(self, mission: Flown, uav: int) -> dict[str, Any]:
        queues = [self._random.randrange(60) for _ in range(SENSORS)]
        return {"uav_id": uav, "position": [500.0 + 10 * uav, 450.0], "sensors": sensor_columns(mission.step, queues)}

    def _record(self, mission: Flown, answer: dict[str, Any]) -> None:
        cost = self._random.random()
        mission.outcomes[answer["uav_id"]] = {"decision_id": answer["decision_id"], "cost": cost, "failed": cost > 0.8}
        mission.decisions += 1


def at_once(radios: Sequence[Radio], jobs: Sequence[Callable[[Radio], float | None]]) -> list[float]:
    """Run all jobs, one at a time on each radio; returns the results."""
    waiting, results, errors = iter(jobs), list[float](), list[BaseException]()
    lock = threading.Lock()

    def run(radio: Radio) -> None:
        try:
            while True:
                with lock:
                    job = next(waiting, None)
                if job is None or errors:
                    return
                if (result := job(radio)) is not None:
                    results.append(result)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(radio,), daemon=True) for radio in radios]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return results


def paced(radios: Sequence[Radio], missions: Sequence[Flown], count: int, pace: float, learn: bool) -> list[float]:
    """Start decisions at even intervals, without waiting for earlier answers while a radio is free."""
    began = time.perf_counter()

    def at(index: int) -> Callable[[Radio], float]:
        def decide(radio: Radio) -> float:
            time.sleep(max(0.0, began + index / pace - time.perf_counter()))
            return radio.decide(missions[index % len(missions)], learn)

        return decide

    return at_once(radios, [at(index) for index in range(count)])
