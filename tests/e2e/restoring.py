"""Flying on from a store that an earlier version of the edge left: requests, and what it answered to them."""

from __future__ import annotations

import hashlib
import json
import math
import re
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import torch
from fastapi.responses import Response

from service.api.app import create_app
from service.config.settings import Settings
from service.learning.initial_weights import initial_weights
from service.learning.learner import Learner
from service.learning.modules import Sample
from service.storage.store import Store
from shared.belief.radio_map import RadioMap
from tests.support.running import serving
from tests.support.waiting import PATIENCE_S
from tests.unit.service.stub_llm import StubLlm, said, wait_for

FOLDER = Path(__file__).with_name("store_601e8f2")
STORE, FLIGHTS = FOLDER / "missions.db", FOLDER / "flights.json"
Body = dict[str, Any]

# No clock decides: a search for a plan ends after its changes, and the deadline is far.
SETTINGS = {"AICVDS_PLANNER_MS": "60000", "AICVDS_DEADLINE_MS": "60000", "AICVDS_LOG_LEVEL": "warning"}
# Between machines whose arithmetic differs in the last bits, and between scores that are rounded to four digits: those
# of a tie may be in another order.
_NEARLY, _TIE = 1e-4, 2e-4


class DrawingLlm(StubLlm):
    """Names what its grammar allows by a hash of the prompt, so that another prompt gets another answer."""

    async def respond(self, body: Body, probed: bool) -> Response:
        """The draw."""
        if probed:
            return await super().respond(body, probed)
        drawn = int(hashlib.sha256(json.dumps(body["messages"]).encode()).hexdigest()[:12], 16)
        groups = re.findall(r'"\w+"(?: \| "\w+")*', body.get("grammar", ""))
        lists = [re.findall(r"\w+", group) for group in groups]
        return said(" ".join(names[drawn % len(names)] for names in lists) or "0 0")


def answers(store: Path, requests: list[Body], llm: str, to: Path) -> list[Body]:
    """What an edge answers that begins with a copy of the store; ``llm`` is ``drawing`` or ``off``."""
    shutil.copy(store, to)
    stub = DrawingLlm()
    with serving(stub.app) as llm_url:
        way: Body = {"mode": "value"} if llm == "off" else {"mode": "guided", "llm_url": f"{llm_url}/v1"}
        app = create_app(Settings(planner_ms=60_000, deadline_ms=60_000, **way), Store(str(to)))
        with serving(app) as url, httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
            wait_for(client, "off" if llm == "off" else "ready")
            return Flying(client, stub).answers(requests)


class Flying:
    """Sends requests one after another; in them and in the answers a decision made meanwhile is ``decision:3.0``.

    That is the first one of the answer to request 3: its ID is drawn anew each time.
    """

    def __init__(self, client: httpx.Client, stub: DrawingLlm) -> None:
        self._client, self._stub = client, stub
        self._names: dict[str, str] = {}

    def answers(self, requests: list[Body]) -> list[Body]:
        """One a request."""
        return [self._answer(number, request) for number, request in enumerate(requests)]

    def _answer(self, number: int, request: Body) -> Body:
        content = json.dumps(request["body"]) if "body" in request else None
        for decision_id, name in self._names.items():
            content = content and content.replace(f'"{name}"', f'"{decision_id}"')
        asked = len(self._stub.bodies)
        headers = {"Content-Type": "application/json", **request.get("headers", {})}
        answer = self._client.request(request["method"], request["path"], content=content, headers=headers)
        body = answer.json()
        made: Body = {"status": answer.status_code}
        prompts = []
        for turn, decision in enumerate(_decisions(body)):
            # A batch's UAVs share its time by the clock.
            for timed in ("latency_ms", "deadline_ms"):
                del decision[timed]
            # Under an Idempotency-Key of before comes the decision of then.
            if not request.get("repeated"):
                self._names[decision["decision_id"]] = f"decision:{number}.{turn}"
                prompts.append(self._prompt(decision))
        if "ETag" in answer.headers:
            made["etag"] = answer.headers["ETag"]
            del body["weights"]
        if prompts:
            made["prompts"] = prompts
        if self._stub.bodies[asked:]:
            made["asked"] = [digest(body) for body in self._stub.bodies[asked:]]
        text = json.dumps(body)
        for decision_id, name in self._names.items():
            text = text.replace(decision_id, name)
        return {**made, "body": json.loads(text)}

    def _prompt(self, decision: Body) -> str:
        path = f"/missions/{decision['mission_id']}/decisions/{decision['decision_id']}/prompt"
        shown = self._client.get(path)
        return digest({name: shown.json()[name] for name in ("asked", "static", "experiences", "state")})


def _decisions(body: Any) -> list[Body]:
    if not isinstance(body, dict):
        return []
    decisions: list[Body] = body["decisions"] if isinstance(body.get("decisions"), list) else [body]
    return decisions if all("velocity" in decision for decision in decisions) else []


def digest(body: Body) -> str:
    """Of a JSON object, enough to tell two apart."""
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()[:16]


def arithmetic() -> str:
    """What numpy, torch and numba make of some numbers here: where that is as recorded, so is every bit that follows.

    Numba's functions call the C library's exponentials.
    """
    random = np.random.default_rng(0)
    numbers = random.normal(size=(16, 16)).astype(np.float32)
    tensor = torch.from_numpy(numbers)
    made = [numbers @ numbers[0], numbers @ numbers, np.exp(numbers), np.tanh(numbers), np.log(numbers**2)]
    made += [
        numbers.sum(axis=1),
        *(t.numpy() for t in (tensor @ tensor[0], tensor @ tensor, tensor.softmax(-1), tensor.sum(-1))),
    ]
    radio_map = RadioMap(4)
    for place in random.uniform(0, 1000, (30, 2)):
        radio_map.measure(np.arange(4), place, random.normal(0, 8, 4))
    made += radio_map.predict(random.uniform(0, 1000, (5, 2)), np.arange(4))
    learner = Learner(initial_weights("pretrained", "paper", 15, 0), learning_rate=1e-2)
    for rows in numbers:
        learner.update(Sample(rows[:15].reshape(3, 5), 1, rows[15:], 7), cost=0.5)
    made.append(learner.weights.flat)
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in made)).hexdigest()[:16]


def unlike(told: Any, expected: Any, exact: bool, at: str = "") -> list[str]:
    """Where an answer is not as expected; it may have fields more.

    Args:
        exact: to the bit; else numbers nearly, candidates of equal scores in any order, and no digest of what has
            rounded numbers in it.
    """
    if isinstance(expected, dict) and isinstance(told, dict):
        digests = () if exact else ("etag", "prompts", "asked")
        missing = [f"{at}.{name} is missing" for name in expected if name not in told]
        both = [name for name in expected if name in told and name not in digests]
        return missing + [fault for name in both for fault in unlike(told[name], expected[name], exact, f"{at}.{name}")]
    if isinstance(expected, list) and isinstance(told, list) and len(told) == len(expected):
        if not exact:
            told, expected = _ties_in_order(told), _ties_in_order(expected)
        pairs = enumerate(zip(told, expected, strict=True))
        return [fault for place, pair in pairs for fault in unlike(*pair, exact, f"{at}[{place}]")]
    numbers = isinstance(expected, float) and isinstance(told, float)
    if numbers and not exact and math.isclose(told, expected, rel_tol=_NEARLY, abs_tol=_NEARLY):
        return []
    return [] if type(told) is type(expected) and told == expected else [f"{at}: {told!r}, not {expected!r}"]


def _ties_in_order(rows: list[Any]) -> list[Any]:
    """Candidates, best first, those of nearly the same score in the order of their actions; any other list as it is."""
    if not all(isinstance(row, dict) and row.keys() >= {"score", "sensor_id", "velocity"} for row in rows):
        return rows
    ranks = np.cumsum([0.0, *(abs(before["score"] - row["score"]) > _TIE for before, row in pairwise(rows))])
    order = sorted(
        range(len(rows)), key=lambda place: (ranks[place], rows[place]["sensor_id"], rows[place]["velocity"])
    )
    return [rows[place] for place in order]
