"""Readings sent to the edge: in batches by mission, again while it is away, and not again where it refuses them."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from datetime import UTC, datetime

import httpx
from pydantic import ValidationError

from field.lorawan.counts import Counts
from field.lorawan.waiting_readings import Intake, Waiting
from shared.wire.problem import Problem
from shared.wire.readings import MAX_AGE_S, ReadingsRequest, ReadingsResponse, SensorReading

log = logging.getLogger(__name__)

_TIMEOUT_S = 10.0
_MOST = 500
# Seconds until a mission is asked again that has not begun, or that the edge does not know.
_AGAIN_S = 5.0
# The pause after a failure of the edge: the first, and the longest after doubling.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 30.0
# Answers to readings that the edge can never take.
_HOPELESS = frozenset((400, 413, 415, 422))
_MISDIRECTED = 421


class EdgeAway(Exception):
    """The edge did not answer, or cannot serve now; the text says why."""


class Reporting:
    """Sends what waits in an intake to an edge; one thread uses it.

    Args:
        edge: base URL, without a slash at its end.
        key: an API key with the scope ``readings``, if the edge needs one.
    """

    def __init__(
        self, edge: str, key: str | None, intake: Intake, counts: Counts, transport: httpx.BaseTransport | None = None
    ) -> None:
        headers = {"Content-Type": "application/json"} | ({} if key is None else {"Authorization": f"Bearer {key}"})
        # A proxy named in the environment cannot reach an edge on this machine.
        beyond = httpx.URL(edge).host not in ("localhost", "127.0.0.1", "::1")
        self._http = httpx.Client(
            base_url=edge, headers=headers, timeout=_TIMEOUT_S, transport=transport, trust_env=beyond
        )
        self._intake = intake
        self._counts = counts
        self._again_at: dict[str, float] = {}
        self._pause_s = 0.0
        self._refused: set[str] = set()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def report(self) -> float:
        """Send everything that waits, once; returns the seconds until the next time that is worth it."""
        now = time.monotonic()
        due = self._intake.due()
        try:
            while due:
                mission_id, readings = next(iter(due.items()))
                if self._again_at.get(mission_id, 0.0) > now:
                    self._intake.put_back(readings)
                else:
                    for start in range(0, len(readings), _MOST):
                        self._send(mission_id, readings[start : start + _MOST])
                    self._pause_s = 0.0
                del due[mission_id]
        except EdgeAway as error:
            # Those that the edge has already are duplicates next time.
            for unsent in due.values():
                self._intake.put_back(unsent)
            self._counts.failures.inc()
            self._pause_s = min(max(_FIRST_PAUSE_S, 2 * self._pause_s), _LONGEST_PAUSE_S)
            log.warning("the edge takes no readings, the next attempt is in %g s: %s", self._pause_s, error)
            return self._pause_s
        return _FIRST_PAUSE_S

    def _send(self, mission_id: str, readings: Sequence[Waiting]) -> None:
        """Send readings of one mission, one by one where the edge refuses them together; raises ``EdgeAway``."""
        body = ReadingsRequest(readings=[_wire(reading) for reading in readings]).model_dump_json(exclude_none=True)
        try:
            answer = self._http.post(f"/missions/{mission_id}/readings", content=body)
            if answer.status_code == _MISDIRECTED and "Location" in answer.headers:
                # Of several edges, another one has the mission.
                answer = self._http.post(answer.headers["Location"], content=body)
        except httpx.HTTPError as error:
            raise EdgeAway(str(error) or type(error).__name__) from None
        # 409: the mission cannot be loaded from the edge's store, until somebody deletes it.
        if answer.status_code in (404, 409):
            self._wait(mission_id, readings, "no_mission")
        elif answer.status_code in _HOPELESS:
            if len(readings) == 1:
                self._refuse(readings[0], answer)
            else:
                for reading in readings:
                    self._send(mission_id, [reading])
        elif answer.is_success:
            self._count(mission_id, readings, answer)
        else:
            raise EdgeAway(f"{answer.status_code} {_problem(answer)}")

    def _count(self, mission_id: str, readings: Sequence[Waiting], answer: httpx.Response) -> None:
        try:
            results = ReadingsResponse.model_validate_json(answer.content).results
            answered = list(zip(readings, results, strict=True))
        except ValueError:
            raise EdgeAway("it answered with something else: is that an AIC-VDS edge?") from None
        early = []
        now = datetime.now(UTC)
        for reading, result in answered:
            if result == "early":
                early.append(reading)
                continue
            self._counts.readings.labels(result).inc()
            self._counts.age_s.observe(max(0.0, (now - reading.at).total_seconds()))
        if early:
            self._wait(mission_id, early, "early")

    def _wait(self, mission_id: str, readings: Sequence[Waiting], why: str) -> None:
        """Keep readings of a mission that is not there yet, or has not begun; a newer one replaces each."""
        self._counts.readings.labels(why).inc(len(readings))
        self._again_at[mission_id] = time.monotonic() + _AGAIN_S
        self._intake.put_back(list(readings))

    def _refuse(self, reading: Waiting, answer: httpx.Response) -> None:
        self._counts.readings.labels("refused").inc()
        sensor = f"sensor {reading.sensor_id} of mission {reading.mission_id}"
        # A wrong mapping refuses every reading of its sensor; its first line in the log is enough.
        if sensor not in self._refused:
            self._refused.add(sensor)
            log.warning("%s: the edge refuses its readings: %s", sensor, _problem(answer))


def _wire(reading: Waiting) -> SensorReading:
    age_s = (datetime.now(UTC) - reading.at).total_seconds()
    return SensorReading(
        sensor_id=reading.sensor_id,
        queue=min(reading.queue, 100_000.0),
        battery=reading.battery,
        age_s=min(max(0.0, age_s), MAX_AGE_S),
        message_id=reading.message_id,
    )


def _problem(answer: httpx.Response) -> str:
    try:
        return Problem.model_validate_json(answer.content).detail
    except ValidationError:
        return answer.text.strip()[:200]
