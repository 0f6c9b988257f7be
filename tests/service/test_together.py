"""A fleet's step in one call of the LLM, where the server can; else about one UAV after the other."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from fastapi.responses import Response

from service.candidates import GuidedTemplate
from service.llm.answer import constrain_labels
from tests.running import listening, serving
from tests.service.making import PAPER
from tests.service.stub_llm import PROBE, StubLlm, misbehaving, said, silent, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


class Chorus(StubLlm):
    """Answers the first letter of every list that it is asked about; ``deaf`` ones answer one letter, whatever."""

    def __init__(self, deaf: bool = False) -> None:
        super().__init__()
        self.deaf = deaf
        self.prose = False

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        lists = body.get("grammar", "").removeprefix("root ::= ").split(r' "\n" ')
        if "7301" in lists[0]:
            return said(f"{PROBE} 0")
        letters = [next(iter(re.findall(r'"([A-Z])"', choice)), self.answer) for choice in lists]
        usage = {"prompt_tokens": 400, "completion_tokens": 2 * len(lists) - 1}
        return said("I would rather not." if self.prose else "\n".join(letters[:1] if self.deaf else letters), usage)

    def questions(self) -> list[str]:
        """What was asked about decisions: neither probes nor questions that say nothing."""
        told = [body["messages"][-1]["content"] for body in self.bodies]
        return [text for text in told if text != "Say hello." and not set("?/") & set(text)]


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


@pytest.mark.parametrize("settings", [{}, {"llm_context": 700, "experiences": 0}])
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


def test_a_server_that_stops_to_answer_for_all_is_not_asked_so_again(edge: Edge, report: Report) -> None:
    chorus = Chorus()
    with serving(chorus.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        chorus.prose = True
        decisions = decided(client, batch(report))
        assert {(d["source"], d["reason"]) for d in decisions} == {("policy", "answer_format")}
        chorus.prose = False
        decisions = decided(client, batch(report, step=1))
    assert {(d["source"], d["reason"]) for d in decisions} == {("guided", None)}
    assert [question.count("UAV") for question in chorus.questions()] == [3, 0, 0, 0]


def test_a_silent_server_keeps_nobody_waiting(edge: Edge, report: Report) -> None:
    with listening(misbehaving(silent)) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        begun = time.perf_counter()
        decisions = decided(client, batch(report, deadline_ms=1500))
        took = time.perf_counter() - begun
    assert {decision["reason"] for decision in decisions} == {"llm_timeout"}
    # Far from what a UAV would wait that were asked about without limit.
    assert took < 10


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
