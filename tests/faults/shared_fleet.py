"""Missions under load on edges that share a store, and what is lost, applied twice or late while something fails."""

from __future__ import annotations

import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx

from tests.faults.fleet import Report
from tests.faults.table import Tables
from tests.support.shared_store import DEADLINE_MS, GIVEN_UP_MS
from tests.support.waiting import PATIENCE_S, until

MISSIONS, LEASE_S = 4, 2.0
# An answer may be so late.
_SLACK_S = 0.25


class Uav(threading.Thread):
    """Flies a mission of its own over the address. It sends again what was not acknowledged, and follows a 421 once.

    Attributes:
        acknowledged: outcomes that an edge said to have on disk.
        decided_at: when the latest decision came.
        answers: requests by what came of them.
        wrong: why it gave up, if it did.
    """

    def __init__(self, number: int, url: str, report: Report) -> None:
        super().__init__(daemon=True)
        self.mission = f"shared{number}"
        self._url, self._report = url, report
        self.acknowledged = 0
        self.decided_at = time.monotonic()
        self.answers: Counter[str] = Counter()
        self.slowest_s = 0.0
        self.wrong: str | None = None
        self.over = False

    def run(self) -> None:
        try:
            with httpx.Client() as client:
                step = 0
                while not self.over:
                    pending = self._decide(client, step)
                    if pending is not None:
                        self._tell(client, pending)
                    step += 1
        except (AssertionError, httpx.HTTPError) as error:
            self.wrong = repr(error)

    def _decide(self, client: httpx.Client, step: int) -> dict[str, Any] | None:
        """One decision, under one key however often it is asked for; the outcome to report if it is on disk."""
        body = self._report(step=step, mission_id=self.mission, deadline_ms=DEADLINE_MS)
        answer = self._until_answered(client, "/decide", body)
        if answer is None:
            return None
        assert answer.status_code == 200, answer.text
        self.decided_at = time.monotonic()
        if not answer.json()["stored"]:
            return None
        return {"mission_id": self.mission, "decision_id": answer.json()["decision_id"], "cost": step % 7 / 10}

    def _tell(self, client: httpx.Client, outcome: dict[str, Any]) -> None:
        answer = self._until_answered(client, "/feedback", outcome)
        if answer is not None:
            assert answer.status_code == 200, f"an outcome of a stored decision was refused: {answer.text}"
            self.acknowledged += 1

    def _until_answered(self, client: httpx.Client, path: str, body: dict[str, Any]) -> httpx.Response | None:
        headers = {"Idempotency-Key": uuid.uuid4().hex} if path == "/decide" else {}
        # A request that is not answered at the end is sent again until it is: the test has to know its answer.
        ends = None
        while ends is None or time.monotonic() < ends:
            if self.over and ends is None:
                ends = time.monotonic() + 30
            answer = self._once(client, f"{self._url}{path}", body, headers)
            if answer is not None:
                return answer
            time.sleep(0.05)
        return None

    def _once(
        self, client: httpx.Client, url: str, body: dict[str, Any], headers: dict[str, str]
    ) -> httpx.Response | None:
        """The answer of an edge that has the mission; None where the request is to be sent again."""
        began = time.monotonic()
        try:
            answer = client.post(url, json=body, headers=headers, timeout=60)
        except httpx.TransportError:
            # A proxy closes some connections whose edge was killed, and leaves it to the client to try again.
            self.answers["broken"] += 1
            return None
        self.slowest_s = max(self.slowest_s, time.monotonic() - began)
        if answer.status_code == 421:
            self.answers["421"] += 1
            assert "Retry-After" in answer.headers
            try:
                answer = client.post(answer.headers["Location"], json=body, headers=headers, timeout=DEADLINE_MS / 1e3)
            except httpx.TransportError:
                self.answers["owner silent"] += 1
                return None
        if answer.status_code in (421, 502, 503, 504):
            self.answers["refused"] += 1
            assert "Retry-After" in answer.headers, f"{answer.status_code} without Retry-After: {answer.text}"
            return None
        self.answers["answered"] += 1
        return answer


class Trial:
    """A fleet over one address, and what is measured of one kind of fault."""

    def __init__(self, url: str, fleet: list[Uav]) -> None:
        self.url, self.fleet = url, fleet
        self.gaps_s: list[float] = []

    def goes_on(self) -> None:
        """Wait until every mission has been decided since now, and note how long the slowest took."""
        began = time.monotonic()

        def decided() -> bool:
            assert [uav.wrong for uav in self.fleet] == [None] * len(self.fleet)
            return all(uav.decided_at > began for uav in self.fleet)

        until(decided, lambda: [uav.answers for uav in self.fleet])
        self.gaps_s.append(max(uav.decided_at for uav in self.fleet) - began)

    def finish(self, tables: Tables, title: str, fault: str, times: int) -> None:
        """Count what the missions have, and add the row."""
        for uav in self.fleet:
            uav.over = True
        for uav in self.fleet:
            uav.join(PATIENCE_S)
            assert not uav.is_alive()
        assert [uav.wrong for uav in self.fleet] == [None] * len(self.fleet)
        lost = twice = 0
        for uav in self.fleet:
            applied = self._status(uav.mission)["feedback"]
            lost += max(0, uav.acknowledged - applied)
            twice += max(0, applied - uav.acknowledged)
        answers = sum((uav.answers for uav in self.fleet), Counter[str]())
        slowest = max(uav.slowest_s for uav in self.fleet)
        tables.add(
            title,
            fault=fault,
            times=times,
            outcomes_acknowledged=sum(uav.acknowledged for uav in self.fleet),
            lost=lost,
            applied_twice=twice,
            answered=answers["answered"],
            sent_to_the_owner_by_421=answers["421"],
            refused_with_Retry_After=answers["refused"],
            connections_closed=answers["broken"],
            slowest_answer_or_refusal_s=f"{slowest:.2f}",
            lease_s=LEASE_S,
            all_missions_decided_again_s=f"{max(self.gaps_s):.2f}",
        )
        assert (lost, twice) == (0, 0)
        assert slowest < GIVEN_UP_MS / 1e3 + _SLACK_S
        assert sum(uav.acknowledged for uav in self.fleet) > 20 * times

    def _status(self, mission_id: str) -> dict[str, Any]:
        found: list[dict[str, Any]] = []

        def read() -> bool:
            answer = httpx.get(f"{self.url}/missions/{mission_id}", timeout=PATIENCE_S)
            if answer.status_code == 421:
                answer = httpx.get(answer.headers["Location"], timeout=PATIENCE_S)
            if answer.status_code == 200:
                found.append(answer.json())
            return bool(found)

        until(read)
        return found[0]


@contextmanager
def flying(url: str, report: Report) -> Iterator[Trial]:
    """A fleet under way over the address."""
    fleet = [Uav(number, url, report) for number in range(MISSIONS)]
    trial = Trial(url, fleet)
    for uav in fleet:
        uav.start()
    try:
        trial.goes_on()
        trial.gaps_s.clear()
        yield trial
    finally:
        for uav in fleet:
            uav.over = True
