"""Two real llama.cpp servers: missions are shared out, each finds its prompts in a cache, and a dead server's move."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import httpx
import pytest

from service.config.settings import Settings
from service.llm.model_file import embedded_model
from service.llm.server_pool import weight
from tests.integration.service.llm.test_server_pool import standing_by
from tests.support.edge_stub import free_port
from tests.support.llama_server import running
from tests.support.waiting import PATIENCE_S

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

NAMES, SLOTS = ("first", "second"), 2


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit in ("connection.PROBE_TIMEOUT_S", "probing.TOGETHER_TIMEOUT_S", "calibration.TIMEOUT_S"):
        monkeypatch.setattr(f"service.llm.{limit}", PATIENCE_S)
    monkeypatch.setattr("service.llm.server.RETRY_S", 0.2)


class Missions:
    """Missions of one UAV, as many for each server as that has slots."""

    def __init__(self, client: httpx.Client, urls: dict[str, str], report: Report) -> None:
        self._client, self._report = client, report
        names = (f"mission-{number}" for number in range(1000))
        self.home: dict[str, str] = {}
        while len(self.home) < SLOTS * len(NAMES):
            mission = next(names)
            server = max(NAMES, key=lambda name: weight(mission, urls[name]))
            if list(self.home.values()).count(server) < SLOTS:
                self.home[mission] = server
        self._outcomes: dict[str, dict[str, Any] | None] = dict.fromkeys(self.home)

    def decide(self, step: int) -> Iterator[tuple[str, dict[str, Any]]]:
        """Each mission's decision, with the outcome of the one before."""
        for mission, outcome in self._outcomes.items():
            body = self._report(mission_id=mission, step=step, outcome=outcome)
            answer = self._client.post("/decide", json=body).json()
            assert answer["source"] == "llm", answer["reason"]
            self._outcomes[mission] = {"decision_id": answer["decision_id"], "cost": 0.1}
            yield mission, answer


@pytest.mark.usefixtures("patient")
def test_missions_stay_with_their_server_and_its_cache(edge: Edge, report: Report) -> None:
    gguf = str(embedded_model(Settings()))
    ports = {name: free_port() for name in NAMES}
    urls = {name: f"http://127.0.0.1:{port}/v1" for name, port in ports.items()}
    with ExitStack() as stack:
        processes = {name: stack.enter_context(running(ports[name], name, gguf, SLOTS)) for name in NAMES}
        client = edge(mode="llm", llm_url=",".join(urls.values()), llm_order="mission", llm_slots=SLOTS)
        standing_by(client, 1)
        missions = Missions(client, urls, report)
        for step in range(3):
            for mission, answer in missions.decide(step):
                assert answer["model"] == missions.home[mission]
                # By llama.cpp's own count: the static block and, from the third decision on, the experience before.
                cached, static = answer["tokens"]["cached"], answer["tokens"]["static"]
                assert step == 0 or cached >= static
                assert step < 2 or cached > static, f"{mission} reads its experiences again"

        processes["first"].kill()
        processes["first"].wait()
        for step in (3, 4):
            assert {answer["model"] for _, answer in missions.decide(step)} == {"second"}

        stack.enter_context(running(ports["first"], "first", gguf, SLOTS))
        standing_by(client, 1)
        for mission, answer in missions.decide(5):
            assert answer["model"] == missions.home[mission]
