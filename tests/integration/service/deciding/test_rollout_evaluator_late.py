"""A critic that is late: the decision is the policy's, within its deadline, and nobody judges in vain."""

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from service.deciding.deliberation import Deliberation, LlmAdvice
from service.deciding.llm_query import LlmQueries
from service.deciding.modes import _evaluation_of
from service.deciding.rollout_evaluator import Evaluation
from shared.kit.cores import usable_cores
from tests.support.running import serving
from tests.support.stub_llm import StubLlm, wait_for
from tests.support.waiting import Clock, Gate, soon

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

NOBODY = "http://127.0.0.1:9/v1"


class Stuck:
    """Judges when it is let go."""

    def __init__(self) -> None:
        self.gate = Gate(opened=True)
        self._evaluate = Deliberation.evaluate

    def evaluate(self, deliberation: Deliberation) -> Evaluation:
        self.gate.wait()
        return self._evaluate(deliberation)


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stuck]:
    critic = Stuck()
    monkeypatch.setattr(Deliberation, "evaluate", lambda deliberation: critic.evaluate(deliberation))
    with critic.gate:
        yield critic


# The LLM has all the time that a busy machine needs, and the evaluator none after the deadline.
@pytest.mark.parametrize(("heard", "deadline_ms"), [(True, 5_000), (False, 500)])
def test_the_policy_decides_for_a_late_critic(
    edge: Edge, report: Report, stuck: Stuck, heard: bool, deadline_ms: int
) -> None:
    with serving(StubLlm("A").app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1" if heard else NOBODY)
        wait_for(client, "ready" if heard else "unavailable")
        client.post("/decide", json=report())
        stuck.gate.shut()
        answer = client.post("/decide", json=report(step=1, deadline_ms=deadline_ms)).json()
        assert (answer["source"], answer["model"], answer.get("guided")) == ("policy", None, None)
        assert answer["reason"] == ("critic_timeout" if heard else "llm_unavailable")
        assert "aicvds_critic_timeouts_total 1.0" in client.get("/metrics").text
        stuck.gate.open()
        again = client.post("/decide", json=report(step=2)).json()
        assert again["guided"]["candidates"]


def test_a_critic_that_fails_is_no_error_of_the_decision(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_: Deliberation) -> Evaluation:
        raise ImportError("numba is broken")

    monkeypatch.setattr(Deliberation, "evaluate", broken)
    with serving(StubLlm("A").app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        answer = client.post("/decide", json=report()).json()
    assert (answer["source"], answer["reason"]) == ("policy", "critic_timeout")
    assert "numba is broken" in caplog.text


async def test_an_evaluation_that_the_ending_service_cancels_counts_as_late() -> None:
    cancelled: asyncio.Future[Evaluation] = asyncio.get_running_loop().create_future()
    cancelled.cancel()
    assert _evaluation_of(cancelled) is None


def test_what_nobody_waits_for_any_more_is_not_judged(
    edge: Edge, report: Report, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    judges, many, ask = usable_cores(), usable_cores() + 6, LlmQueries.ask

    async def when_all_judge(self: LlmQueries, *asked: Any) -> LlmAdvice:
        await soon(lambda: stuck.gate.callers >= judges)
        return await ask(self, *asked)

    monkeypatch.setattr(LlmQueries, "ask", when_all_judge)
    client = edge(mode="guided", llm_url=NOBODY)
    stuck.gate.shut()
    bodies = [report(mission_id=f"m{number}", deadline_ms=100) for number in range(many)]
    with ThreadPoolExecutor(many) as uavs:
        answers = list(uavs.map(lambda body: client.post("/decide", json=body).json(), bodies))
    assert [answer.get("guided") for answer in answers] == [None] * many
    stuck.gate.open()
    # It is judged behind whatever is queued.
    assert client.post("/decide", json=report(mission_id="m0", step=1)).json()["guided"]
    assert stuck.gate.callers == judges + 1


def fleet(report: Report) -> dict[str, Any]:
    uavs = [
        {key: value for key, value in report(uav_id=u).items() if key not in ("mission_id", "step")} for u in (0, 1)
    ]
    return {"mission_id": "test", "step": 0, "uavs": uavs}


def test_a_batch_keeps_its_deadline(edge: Edge, report: Report, stuck: Stuck) -> None:
    client = edge(mode="guided", llm_url=NOBODY)
    stuck.gate.shut()
    # Answered at all: the critic is never let go.
    decisions = client.post("/decide/batch", json={**fleet(report), "deadline_ms": 200}).json()["decisions"]
    assert [(d["source"], d.get("guided")) for d in decisions] == [("policy", None)] * 2
    assert len({d["sensor_id"] for d in decisions}) == 2


def test_in_a_batch_the_critic_may_take_what_the_others_do_not_need(
    edge: Edge, report: Report, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, ask = Clock(), LlmQueries.ask

    async def lingering(self: LlmQueries, *asked: Any) -> LlmAdvice:
        """The first UAV's half of the minute is over, and the critic is done a moment after that."""
        reported = await ask(self, *asked)
        if not clock.ahead_s:
            await soon(lambda: stuck.gate.callers)
            clock.ahead_s = 40.0
            asyncio.get_running_loop().call_later(0.05, stuck.gate.open)
        return reported

    monkeypatch.setattr(LlmQueries, "ask", lingering)
    monkeypatch.setattr("service.deciding.stopwatch.time", clock)
    client = edge(mode="guided", llm_url=NOBODY)
    stuck.gate.shut()
    decisions = client.post("/decide/batch", json={**fleet(report), "deadline_ms": 60_000}).json()["decisions"]
    assert all(decision["guided"] for decision in decisions)
