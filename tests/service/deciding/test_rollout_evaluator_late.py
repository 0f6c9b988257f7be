"""A critic that is late: the decision is the policy's, within its deadline, and nobody judges in vain."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from service.config.cores import usable_cores
from service.deciding.deliberation import Deliberation
from service.deciding.rollout_evaluator import Judgement
from tests.running import serving
from tests.service.stub_llm import StubLlm, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

NOBODY = "http://127.0.0.1:9/v1"


class Stuck:
    """Judges when it is let go, or after seconds."""

    def __init__(self) -> None:
        self.begun = 0
        self.go = threading.Event()
        self._evaluate = Deliberation.evaluate

    def evaluate(self, deliberation: Deliberation) -> Judgement:
        self.begun += 1
        self.go.wait(5)
        return self._evaluate(deliberation)


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stuck]:
    critic = Stuck()
    monkeypatch.setattr(Deliberation, "evaluate", lambda deliberation: critic.evaluate(deliberation))
    yield critic
    critic.go.set()


@pytest.mark.parametrize("heard", [True, False])
def test_the_policy_decides_for_a_late_critic(edge: Edge, report: Report, stuck: Stuck, heard: bool) -> None:
    with serving(StubLlm("A").app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1" if heard else NOBODY)
        wait_for(client, "ready" if heard else "unavailable")
        stuck.go.set()
        # The first decision of a process loads the planner.
        client.post("/decide", json=report())
        stuck.go.clear()
        answer = client.post("/decide", json=report(step=1, deadline_ms=800)).json()
        assert (answer["source"], answer["model"], answer.get("guided")) == ("policy", None, None)
        assert answer["reason"] == ("critic_timeout" if heard else "llm_unavailable")
        assert "aicvds_critic_timeouts_total 1.0" in client.get("/metrics").text
        stuck.go.set()
        again = client.post("/decide", json=report(step=2)).json()
        assert again["guided"]["candidates"]


def test_what_nobody_waits_for_any_more_is_not_judged(edge: Edge, report: Report, stuck: Stuck) -> None:
    client, many = edge(mode="guided", llm_url=NOBODY), usable_cores() + 6
    bodies = [report(mission_id=f"m{number}", deadline_ms=400) for number in range(many)]
    with ThreadPoolExecutor(many) as uavs:
        answers = list(uavs.map(lambda body: client.post("/decide", json=body).json(), bodies))
    assert [answer.get("guided") for answer in answers] == [None] * many
    stuck.go.set()
    # It is judged behind whatever is queued.
    assert client.post("/decide", json=report(mission_id="m0", step=1)).json()["guided"]
    assert stuck.begun == usable_cores() + 1


def test_a_batch_keeps_its_deadline(edge: Edge, report: Report, stuck: Stuck) -> None:
    client = edge(mode="guided", llm_url=NOBODY)
    uavs = [
        {key: value for key, value in report(uav_id=u).items() if key not in ("mission_id", "step")} for u in (0, 1)
    ]
    body = {"mission_id": "test", "step": 0, "uavs": uavs, "deadline_ms": 600}
    decisions = client.post("/decide/batch", json=body).json()["decisions"]
    assert [(d["source"], d.get("guided")) for d in decisions] == [("policy", None)] * 2
    assert len({d["sensor_id"] for d in decisions}) == 2


def test_in_a_batch_the_critic_may_take_what_the_others_do_not_need(edge: Edge, report: Report, stuck: Stuck) -> None:
    client = edge(mode="guided", llm_url=NOBODY)
    uavs = [
        {key: value for key, value in report(uav_id=u).items() if key not in ("mission_id", "step")} for u in (0, 1)
    ]
    body = {"mission_id": "test", "step": 0, "uavs": uavs, "deadline_ms": 4000}
    letting_go = threading.Timer(2.6, stuck.go.set)
    letting_go.start()
    decisions = client.post("/decide/batch", json=body).json()["decisions"]
    letting_go.join()
    assert all(decision["guided"] for decision in decisions)
