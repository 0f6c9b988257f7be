"""Makes the store of tests/e2e/store_601e8f2 with the edge's present code, and records what that answers afterwards.

python -m tests.e2e.make_store           # a new store, new requests, and their answers
python -m tests.e2e.make_store answers   # the answers alone, where they are meant to have changed
"""

from __future__ import annotations

import json
import math
import random
import shutil
import signal
import sqlite3
import sys
import tempfile
from pathlib import Path
from typing import Any

import httpx

from tests.e2e.processes import serving_edge
from tests.e2e.restoring import FLIGHTS, SETTINGS, STORE, Body, DrawingLlm, answers, arithmetic
from tests.support.running import serving
from tests.unit.service.stub_llm import wait_for

SMALL = {"name": "small", "sensors": 6, "uavs": 2, "steps": 40}
WISHES = {"sensors": [{"sensor_id": 2, "visit_every": 3}, {"sensor_id": 4, "weight": 3.0}], "forbidden_velocities": [9]}
SPECS: dict[str, Body] = {
    "guided": {"mode": "guided", "scenario": SMALL, "note": "visit sensor 2 every third step"},
    "llm": {
        "mode": "llm",
        "scenario": SMALL,
        "prompt": {"format": "json", "selection": "similar", "demonstrations": 1},
    },
    "value": {"mode": "value", "seed": 3},
    "policy": {"mode": "policy"},
    "random": {"mode": "value", "features": "paper", "belief": "reported", "init": "random", "top_k": 3},
    "batch": {"mode": "guided", "scenario": SMALL, "prompt": {"order": "shuffled"}},
    "rested": {"mode": "guided", "planner": "off", "scenario": SMALL},
}
# Begun so late that the store has no checkpoint of them.
LATER = {"batch", "llm"}


class Fleet:
    """A small world of circles and queues, and what each UAV of a mission says of it and is owed."""

    def __init__(self, name: str) -> None:
        self.name, self.random = name, random.Random(name)
        scenario = SPECS[name].get("scenario", {"sensors": 10, "uavs": 3})
        self.uavs, self.sensors = scenario["uavs"], scenario["sensors"]
        self.places = [(self.random.uniform(0, 1000), self.random.uniform(0, 1000)) for _ in range(self.sensors)]
        self.queue = [float(self.random.randint(18, 60)) for _ in range(self.sensors)]
        self.flown = [self.random.uniform(0, 1800) for _ in range(self.uavs)]
        self.heard: list[list[Any]] = [[None] * self.sensors for _ in range(self.uavs)]
        self.owed: dict[int, Body] = {}
        self.step = 0
        self.last: Body = {}

    def position(self, uav: int) -> tuple[float, float]:
        lap, here = math.radians(90 + 360 * uav / self.uavs), self.flown[uav] / 300
        return tuple(500 + 250 * f(lap) + 300 * f(here) for f in (math.cos, math.sin))  # type: ignore[return-value]

    def report(self, uav: int) -> Body:
        here = self.position(uav)
        for j, place in enumerate(self.places):
            if (far := math.dist(here, place)) <= 360:
                self.heard[uav][j] = (self.queue[j], 50.0 - self.step / 8, round(-85 - far / 20, 2), self.step)
        columns = list(zip(*((row or (None,) * 4) for row in self.heard[uav]), strict=True))
        named = dict(zip(("queue", "battery", "channel_gain", "last_seen"), map(list, columns), strict=True))
        x, y = ([place[axis] for place in self.places] for axis in (0, 1))
        sensors = {"id": list(range(self.sensors)), "x": x, "y": y, **named}
        said = {"uav_id": uav, "position": list(here), "progress_m": self.flown[uav], "sensors": sensors}
        return {**said, "outcome": self.owed.pop(uav)} if uav in self.owed else said

    def fly(self, uav: int, decision: Body, name: str) -> None:
        self.flown[uav] += 10 * decision["velocity"]
        failed = math.dist(self.position(uav), self.places[decision["sensor_id"]]) > 360
        if not failed:
            self.queue[decision["sensor_id"]] = 0.0
        self.owed[uav] = {"decision_id": name, "cost": round(self.random.random(), 2) + failed, "failed": failed}

    def end_step(self) -> None:
        self.queue = [min(60.0, queue + self.random.randint(1, 8)) for queue in self.queue]
        self.step += 1


class Radio:
    """Sends requests; in those that are recorded a decision made meanwhile goes by its request's number."""

    def __init__(self) -> None:
        self.url, self.requests, self.names, self.recording = "", list[Body](), dict[str, str](), False

    def send(self, method: str, path: str, body: Body | None = None, **more: Any) -> Any:
        request: Body = {"method": method, "path": path, **more} | ({"body": body} if body is not None else {})
        text = json.dumps(body)
        for decision_id, name in self.names.items():
            text = text.replace(f'"{name}"', f'"{decision_id}"')
        sent = None if body is None else json.loads(text)
        got = httpx.request(method, self.url + path, json=sent, headers=more.get("headers", {}), timeout=90)
        answer = got.json()
        print(method, path, got.status_code, file=sys.stderr)
        if self.recording:
            fresh = path.startswith("/decide") and got.status_code == 200 and not more.get("repeated")
            for turn, one in enumerate(answer.get("decisions", [answer]) if fresh else []):
                self.names[one["decision_id"]] = f"decision:{len(self.requests)}.{turn}"
                one["decision_id"] = self.names[one["decision_id"]]
            self.requests.append(request)
        return answer


def fly(radio: Radio, fleet: Fleet, steps: int) -> None:
    """Mission ``batch`` all UAVs at once, ``policy`` under keys, and ``guided`` by delta."""
    based: dict[int, tuple[str, Body]] = {}
    for _ in range(steps):
        reports = [fleet.report(uav) for uav in range(fleet.uavs)]
        common = {"mission_id": fleet.name, "step": fleet.step}
        if fleet.name == "batch":
            for uav, one in enumerate(radio.send("POST", "/decide/batch", {**common, "uavs": reports})["decisions"]):
                fleet.fly(uav, one, one["decision_id"])
        for uav, report in enumerate(reports if fleet.name != "batch" else []):
            keyed = {"headers": {"Idempotency-Key": f"{fleet.step}-{uav}"}} if fleet.name == "policy" else {}
            whole = report["sensors"]
            if uav in based:
                report = {**report, "base": based[uav][0], "sensors": changed(based[uav][1], whole)}
            if fleet.name == "guided":
                report["uplink"] = "delta"
            body = {**common, **report}
            one = radio.send("POST", "/decide", body, **keyed)
            fleet.last = body
            based |= {uav: (one["decision_id"], whole)} if fleet.name == "guided" else {}
            fleet.fly(uav, one, one["decision_id"])
        fleet.end_step()


def changed(before: Body, now: Body) -> Body:
    """The rows that are not as before, without places."""
    names = ("id", "queue", "battery", "channel_gain", "last_seen")
    rows = [j for j in now["id"] if any(now[name][j] != before[name][j] for name in names)]
    return {name: [now[name][j] for j in rows] for name in names}


def ask_about_all(radio: Radio) -> None:
    """Where every mission stands."""
    for name in SPECS:
        for what in ("", "/guidance", "/attention"):
            radio.send("GET", f"/missions/{name}{what}")


def fly_before(radio: Radio, store: Path, llm: Body) -> dict[str, Fleet]:
    """Flights that end in order, and then some more of which the store's copy holds events alone."""
    fleets = {name: Fleet(name) for name in SPECS}
    with serving_edge(AICVDS_STORE=str(store), **SETTINGS, **llm) as (radio.url, process):
        wait(radio)
        for name in sorted(SPECS.keys() - LATER):
            radio.send("PUT", f"/missions/{name}", SPECS[name])
            fly(radio, fleets[name], 1 if name == "rested" else 3)
        radio.send("POST", "/missions/guided/guidance", {"guidance": WISHES})
        process.send_signal(signal.SIGTERM)
        process.wait(30)
    with serving_edge(AICVDS_STORE=str(store), **SETTINGS, **llm) as (radio.url, process):
        wait(radio)
        for name in sorted(LATER):
            radio.send("PUT", f"/missions/{name}", SPECS[name])
        radio.send("POST", "/missions/batch/guidance", {"guidance": {"max_velocity": 12}})
        for name in sorted(SPECS.keys() - {"rested"}):
            fly(radio, fleets[name], 2)
        process.kill()
        process.wait(30)
    return fleets


def fly_after(radio: Radio, fleets: dict[str, Fleet]) -> None:
    """What is recorded: answers under keys of before, outcomes of decisions of before, refusals, and flights."""
    ask_about_all(radio)
    again = fleets["policy"]
    key = {"headers": {"Idempotency-Key": f"{again.step - 1}-2"}}
    radio.send("POST", "/decide", again.last, **key, repeated=True)
    radio.send("POST", "/decide", {**again.last, "step": again.step}, **key)
    owed = {"mission_id": "value", **fleets["value"].owed.pop(1)}
    for cost in (owed["cost"], owed["cost"], owed["cost"] + 0.5):
        radio.send("POST", "/feedback", {**owed, "cost": cost})
    radio.send("POST", "/feedback", {**owed, "decision_id": "0" * 32})
    # What a delta changes was held in memory only.
    gone = {**fleets["guided"].last, "base": fleets["guided"].owed[1]["decision_id"], "step": fleets["guided"].step}
    radio.send("POST", "/decide", {name: value for name, value in gone.items() if name != "outcome"})
    for name in sorted(SPECS):
        fly(radio, fleets[name], 2)
    ask_about_all(radio)


def wait(radio: Radio) -> None:
    """Until the LLM is ready."""
    with httpx.Client(base_url=radio.url, timeout=60) as client:
        wait_for(client, "ready")


def main(words: list[str]) -> None:
    """Make what the words say."""
    with tempfile.TemporaryDirectory() as folder, serving(DrawingLlm().app) as llm_url:
        if words != ["answers"]:
            radio, store = Radio(), Path(folder, "m.db")
            llm = {"AICVDS_MODE": "guided", "AICVDS_LLM_URL": f"{llm_url}/v1"}
            fleets = fly_before(radio, store, llm)
            with sqlite3.connect(store) as db:
                db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                db.execute("PRAGMA journal_mode=DELETE")
            db.execute("VACUUM")
            db.close()
            shutil.copy(store, STORE)
            radio.recording = True
            with serving_edge(AICVDS_STORE=str(store), **SETTINGS, **llm) as (radio.url, _):
                wait(radio)
                fly_after(radio, fleets)
            requests = radio.requests
        else:
            requests = json.loads(FLIGHTS.read_text())["requests"]
        told = {way: answers(STORE, requests, way, Path(folder, f"{way}.db")) for way in ("drawing", "off")}
    recorded = {"arithmetic": arithmetic(), "requests": requests, "answers": told}
    text = json.dumps(recorded, separators=(",", ":"))
    FLIGHTS.write_text(text.replace('{"method"', '\n{"method"').replace('{"status"', '\n{"status"') + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
