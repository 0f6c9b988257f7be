"""A fleet's step in one call of the LLM, where the server can; else about one UAV after the other."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.responses import JSONResponse, Response

from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import LlmAdvice
from service.deciding.llm_query import LlmQueries
from service.deciding.stopwatch import Deadline
from service.llm.request_bodies import constrain_labels
from service.mission.mission import Mission
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.prompt import Prompt
from service.prompting.unpruned_state import UnprunedState
from shared.world.step_rule import Action
from tests.support.missions import PAPER, attended, mission, uav
from tests.support.running import serving
from tests.support.stored_missions import running
from tests.support.stub_llm import PROBE, StubLlm, chat_completion, wait_for
from tests.support.waiting import Clock, Gate, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


class Chorus(StubLlm):
    """Answers the first letter of every list that it is asked about; ``deaf`` ones answer one letter, whatever.

    About several lists it says nothing where the question contains ``hangs_on``, as long as its ``gate`` is shut, and
    refuses what contains ``refuses``.
    """

    def __init__(
        self, *, deaf: bool = False, hangs_on: str = "\0", refuses: str = "\0", gate: Gate | None = None
    ) -> None:
        super().__init__()
        self.deaf, self.hangs_on, self.refuses, self.gate = deaf, hangs_on, refuses, gate or Gate()
        self.prose = False

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        several = r'"\n"' in body.get("grammar", "")
        asked = body["messages"][-1]["content"]
        if several and self.refuses in asked:
            return JSONResponse({}, status_code=400)
        if several and self.hangs_on in asked:
            await self.gate.passed()
        lists = body.get("grammar", "").removeprefix("root ::= ").split(r' "\n" ')
        if "7301" in lists[0]:
            return chat_completion(f"{PROBE} 0")
        letters = [next(iter(re.findall(r'"([A-Z])"', choice)), self.answer) for choice in lists]
        usage = {"prompt_tokens": 400, "completion_tokens": 2 * len(lists) - 1}
        return chat_completion(
            "I would rather not." if self.prose else "\n".join(letters[:1] if self.deaf else letters), usage
        )

    def questions(self) -> list[str]:
        """What was asked about decisions: neither probes nor questions that say nothing."""
        reported = [body["messages"][-1]["content"] for body in self.bodies]
        return [text for text in reported if text != "Say hello." and not set("?/") & set(text)]


def batch(report: Report, step: int = 0, **changes: Any) -> dict[str, Any]:
    uavs = [{key: report(step=step, uav_id=i)[key] for key in ("uav_id", "position", "sensors")} for i in range(3)]
    return {"mission_id": "test", "step": step, "uavs": uavs, **changes}


def decided(client: httpx.Client, body: dict[str, Any]) -> list[dict[str, Any]]:
    response = client.post("/decide/batch", json=body)
    assert response.status_code == 200
    decisions: list[dict[str, Any]] = response.json()["decisions"]
    assert len({decision["sensor_id"] for decision in decisions}) == len(decisions)
    return decisions


def test_three_uavs_are_decided_by_one_call(edge: Edge, report: Report) -> None:
    chorus = Chorus()
    with serving(chorus.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        decisions = decided(client, batch(report))
        metrics = client.get("/metrics").text
    (question,) = chorus.questions()
    assert re.findall(r"^UAV (\d)$", question, re.MULTILINE) == ["0", "1", "2"]
    # After the letter the sensor, then as for one UAV: queue, age, velocities.
    assert re.fullmatch(r"(UAV \d\n([A-Z]\d,\d+,\d+,\d+(-\d+)?\n)+){3}", question)
    system = next(b for b in chorus.bodies if b["messages"][-1]["content"] == question)["messages"][0]["content"]
    assert "one letter for each UAV" in system and "Never choose the same sensor" in system
    assert [decision["source"] for decision in decisions] == ["guided"] * 3
    # All asked for the same sensor: only one can have it, and the LLM's word for the others is what is left of it.
    assert all(decision["guided"]["candidates"][0]["llm"] is not None for decision in decisions)
    assert 'aicvds_llm_requests_total{outcome="ok"} 1.0' in metrics


def test_a_decisions_time_limit_includes_what_later_uavs_can_spare(edge: Edge, report: Report) -> None:
    """The evaluator may use it: such a decision is not past its deadline, and the batch is in time."""
    decisions, spent_ms = decided(edge(mode="value"), batch(report, deadline_ms=60_000)), 0.0
    # Its equal share is a third.
    assert decisions[0]["deadline_ms"] > 50_000
    for decision in decisions:
        assert decision["deadline_ms"] + spent_ms <= 60_000
        # All wait for the disk at once, after the last decision.
        spent_ms += decision["latency_ms"]["total"] - decision["latency_ms"]["store"]


def test_the_call_is_counted_once(edge: Edge, report: Report) -> None:
    with serving(Chorus().app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        first, *others = (decision["tokens"] for decision in decided(client, batch(report)))
    assert (first["server_prompt"], first["completion"]) == (400, 5)
    assert first["static"] > 100
    for tokens in others:
        assert (tokens["static"], tokens["experiences"], tokens["server_prompt"]) == (0, 0, None)
        assert 0 < tokens["prompt"] == tokens["state"] < tokens["uncompressed"]


@pytest.mark.parametrize("settings", [{}, {"llm_context": 1100, "experiences": 0}])
def test_a_server_that_cannot_is_asked_about_one_after_the_other(
    edge: Edge, report: Report, settings: dict[str, Any]
) -> None:
    """It names one letter only, or its context does not hold three UAVs' rows."""
    chorus = Chorus(deaf=not settings)
    with serving(chorus.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1", **settings)
        wait_for(client, "ready")
        decisions = decided(client, batch(report))
    assert [decision["source"] for decision in decisions] == ["guided"] * 3
    assert len(chorus.questions()) == 3
    assert not any("UAV" in question for question in chorus.questions())


def test_a_server_that_stops_to_answer_for_all_is_asked_one_by_one(edge: Edge, report: Report) -> None:
    chorus = Chorus()
    with serving(chorus.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        chorus.prose = True
        decisions = decided(client, batch(report))
        # Asked about all, and then about each, in the same step.
        assert {(d["source"], d["reason"]) for d in decisions} == {("policy", "answer_format")}
        chorus.prose = False
        decisions = decided(client, batch(report, step=1))
    assert {(d["source"], d["reason"]) for d in decisions} == {("guided", None)}
    assert [question.count("UAV") for question in chorus.questions()] == [3, 0, 0, 0, 0, 0, 0]


def fleet(report: Report, uavs: int, step: int = 0, **changes: Any) -> dict[str, Any]:
    one = report(step=step)
    states = [{"uav_id": i, "position": one["position"], "sensors": one["sensors"]} for i in range(uavs)]
    return {"mission_id": "test", "step": step, "uavs": states, **changes}


def test_a_server_that_hangs_keeps_no_fleet_waiting(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight UAVs' candidates are weighed after the LLM's time is over: that must fit into the deadline too."""
    ask_for_fleet, given_s = LlmQueries.ask_for_fleet, list[float]()

    async def timed(
        self: LlmQueries, mission: Mission, states: Sequence[AttendedState], deadline: Deadline
    ) -> dict[int, LlmAdvice]:
        given_s.append(deadline.at - time.perf_counter())
        # All but the last moment of the LLM's time is over.
        clock.ahead_s = max(0.0, given_s[-1] - 0.1)
        return await ask_for_fleet(self, mission, states, deadline)

    clock = Clock()
    monkeypatch.setattr("service.deciding.stopwatch.time", clock)
    monkeypatch.setattr(LlmQueries, "ask_for_fleet", timed)
    # The rest of the deadline passes in real time, and eight evaluations are slow on a busy machine.
    monkeypatch.setattr("service.deciding.rollout_evaluator.FUTURES", 1)
    chorus = Chorus(hangs_on="UAV")
    with serving(chorus.app) as url, chorus.gate:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"scenario": {**PAPER.model_dump(), "uavs": 8}, "planner": "off"})
        for step in range(2):
            response = client.post("/decide/batch", json=fleet(report, 8, step))
            decisions = response.json()["decisions"]
            assert {decision["reason"] for decision in decisions} <= {"llm_timeout", "no_candidate"}
        # What the LLM was waited for is not taken for the edge's own time, and the rest is left to the fleet.
        assert len(given_s) == 2 and max(given_s) <= 45.0
        # Twice late in a row: asked about one by one from now on.
        clock.ahead_s = 0.0
        client.post("/decide/batch", json=fleet(report, 8, 2))
    assert [question.count("UAV") for question in chorus.questions()[:3]] == [8, 8, 0]


@pytest.mark.parametrize(("own_s", "most_s"), [(0.01, 45.0), (5.0, 30.0), (8.0, None)])
def test_a_query_about_all_leaves_twice_the_time_that_the_decisions_need(
    tmp_path: Path, report: Report, monkeypatch: pytest.MonkeyPatch, own_s: float, most_s: float | None
) -> None:
    """Of a minute for three UAVs. With less than a quarter of it the LLM is not asked about all."""
    given_s = list[float]()

    async def timed(
        self: LlmQueries, mission: Mission, states: Sequence[AttendedState], deadline: Deadline
    ) -> dict[int, LlmAdvice]:
        given_s.append(deadline.at - time.perf_counter())
        return {}

    monkeypatch.setattr(LlmQueries, "may_ask_for_fleet", lambda self, mission, uavs: True)
    monkeypatch.setattr(LlmQueries, "ask_for_fleet", timed)
    with running(tmp_path / "m.db", mode="guided", llm_gguf="none", planner="off") as (client, engine):
        engine.pipeline.own_s = own_s
        decided(client, batch(report, deadline_ms=60_000))
    assert len(given_s) == (most_s is not None)
    assert all(seconds <= most_s for seconds in given_s if most_s is not None)


def test_a_question_that_is_refused_is_put_one_by_one_in_the_same_step(edge: Edge, report: Report) -> None:
    chorus = Chorus(refuses="UAV")
    with serving(chorus.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        for step in range(2):
            decisions = decided(client, batch(report, step))
            assert [(d["source"], d["reason"]) for d in decisions] == [("guided", None)] * 3
    assert [question.count("UAV") for question in chorus.questions()] == [3, 0, 0, 0, 0, 0, 0]


def test_a_batch_that_was_sent_again_meanwhile_does_not_count(edge: Edge, report: Report) -> None:
    """Its answer would give away sensors that the later one's UAVs fly to."""
    chorus = Chorus(hangs_on="UAV")
    with serving(chorus.app) as url, ThreadPoolExecutor() as pool, chorus.gate:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"planner": "off"})
        slow = pool.submit(client.post, "/decide/batch", json=batch(report))
        until(lambda: chorus.gate.callers)
        chorus.hangs_on = "\0"
        assert client.post("/decide/batch", json=batch(report)).status_code == 200
        chorus.gate.open()
        assert slow.result().status_code == 409


def test_a_server_that_hangs_on_the_probe_is_asked_one_by_one(
    edge: Edge, report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.llm.probing.TOGETHER_TIMEOUT_S", 0.1)
    chorus = Chorus(hangs_on="Say hello.")
    with serving(chorus.app) as url, chorus.gate:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        assert [d["source"] for d in decided(client, batch(report))] == ["guided"] * 3
    assert not any("UAV" in question for question in chorus.questions())


def test_what_is_left_of_a_word_is_the_llms_word() -> None:
    """A velocity forbidden meanwhile counts as the nearest that is offered; of sensors given away nothing is left."""
    prompt = Prompt("", "", "", UnprunedState(attended(mission(), uav()).state))
    word = LlmAdvice(
        prompt, {Action(1, 9): 0.3, Action(1, 2): 0.1, Action(4, 7): 0.6}, None, None, calibrated=False, model=None
    )
    left = word.over([Action(1, 3), Action(1, 7), Action(2, 7)])
    assert left is not None
    assert left.tolist() == pytest.approx([0.25, 0.75, 0.0])
    assert word.over([Action(2, 7), Action(3, 7)]) is None


def test_what_all_asked_for_is_told_as_given_away(edge: Edge, report: Report) -> None:
    """With k = 1 the LLM is asked about the same sensor for all three."""
    with serving(Chorus().app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1", top_k=1)
        wait_for(client, "ready")
        decisions = decided(client, batch(report))
    assert [(d["source"], d["reason"]) for d in decisions] == [("guided", None), *[("policy", "answer_reserved")] * 2]


def test_mode_llm_asks_as_the_paper_does(edge: Edge, report: Report) -> None:
    chorus = Chorus()
    with serving(chorus.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        decided(client, batch(report))
    assert not any("UAV 1" in body["messages"][-1]["content"] for body in chorus.bodies)


def test_constraints_name_a_label_of_each_list() -> None:
    lists = [["A", "B"], ["A"]]
    assert constrain_labels("grammar", lists[:1]) == {"grammar": 'root ::= "A" | "B"'}
    assert constrain_labels("grammar", lists) == {"grammar": r'root ::= ("A" | "B") "\n" ("A")'}
    assert constrain_labels("structured_outputs", lists[:1]) == {"structured_outputs": {"choice": ["A", "B"]}}
    (regex,) = constrain_labels("structured_outputs", lists)["structured_outputs"].values()
    assert re.fullmatch(regex, "B\nA") and not re.fullmatch(regex, "A\nB")
    assert constrain_labels("json_schema", lists) == {}


def test_what_says_nothing_has_as_many_rows_as_there_can_be() -> None:
    template = GuidedTemplate(PAPER, rows=5, experiences=8, ranked=True)
    for text in template.content_free([0, 2]):
        assert re.findall(r"^UAV (\d)$", text, re.MULTILINE) == ["0", "2"]
        assert re.findall(r"^([A-Z])\?,", text, re.MULTILINE) == list("AEIMQ") * 2
