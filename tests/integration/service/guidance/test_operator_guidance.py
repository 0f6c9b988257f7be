"""Operator guidance over HTTP: compiled beside the decisions, confirmed by the operator, and obeyed by every mode."""

import asyncio
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import httpx
import numpy as np
import pytest
from fastapi.responses import Response
from numpy.typing import NDArray

from service.config.settings import Settings
from service.deciding.advisers import look_ahead
from service.deciding.deliberation import Deliberation
from service.deciding.rollout_evaluator import evaluate
from service.deciding.rollout_state import RolloutState
from service.guidance.note_orders import INSTRUCTION, constrain_orders
from service.guidance.step_guidance import StepGuidance
from service.llm.answers import Completion
from service.llm.client import LLMClient
from service.llm.embedded import EmbeddedServer
from service.llm.request_bodies import Rewriting, WarmUp
from service.llm.server import LlmServer, ServerStatus
from service.mission.mission import Mission
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.paper_prompt import Template
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance, SensorWish
from shared.wire.schemas import MissionSpec
from shared.world.step_rule import Action
from tests.integration.service.api.test_routes import fields
from tests.support.missions import PAPER, attended, mission, uav
from tests.support.running import serving
from tests.support.stub_llm import StubLlm, chat_completion, wait_for
from tests.support.waiting import Gate, soon, until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

NOTE = "Suspected leak at sensor 3: visit it every third step."
ORDERS = "visit sensor 3 every 3 steps"
# The embedded LLM, without its llama.cpp and without adapters.
EMBEDDED = SimpleNamespace(request=lambda *_: nullcontext({}), note_request=lambda: nullcontext({}))
REWRITING = Rewriting(INSTRUCTION, [], NOTE, lambda constraint: constrain_orders(constraint, NOTE))
# Numbers of its own: 3 occurs twice in the note that it is given with.
OWN = {"sensors": [{"sensor_id": 1, "weight": 4.0, "visit_every": 2}], "max_velocity": 5, "forbidden_velocities": [0]}


class Scribe(StubLlm):
    """Says ``orders`` of a note, one after another where it is asked again, and else its answer."""

    def __init__(self, *orders: str, answer: str = "0 7") -> None:
        super().__init__(answer)
        self.orders = list(orders)
        self.asked: list[dict[str, Any]] = []
        self.gate = Gate(opened=True)

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        if probed or not body["messages"][0]["content"].startswith("Rewrite"):
            return await super().respond(body, probed)
        self.asked.append(body)
        await self.gate.passed()
        return chat_completion(self.orders[min(len(self.asked), len(self.orders)) - 1])


def guidance(client: httpx.Client, status: str) -> dict[str, Any]:
    """The mission's guidance once it is in that state."""
    reported: dict[str, Any] = {}

    def there() -> bool:
        reported.update(client.get("/missions/test/guidance").json())
        return bool(reported["status"] == status)

    until(there, lambda: f"the guidance is to be {status}: {reported}")
    return reported


def test_a_note_is_compiled_proposed_and_obeyed_only_once_confirmed(edge: Edge, report: Report) -> None:
    scribe = Scribe(ORDERS)
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        assert client.put("/missions/test", json={"mode": "value", "note": NOTE}).status_code == 200
        reported = guidance(client, "proposed")
        assert reported == {
            "mission_id": "test",
            "status": "proposed",
            "note": NOTE,
            "guidance": {
                "sensors": [{"sensor_id": 3, "weight": 1.0, "visit_every": 3}],
                "min_velocity": None,
                "max_velocity": None,
                "forbidden_velocities": [],
            },
            "in_words": "Visit sensor 3 at least once in every 3 steps.",
            "obeyed_in_words": None,
            "origin": "llm",
            "model": "stub-1",
            "failure": None,
            "doubts": ["How well this LLM reads notes is not known: compare each order with the note."],
            "begins": ["Visit sensor 3 at least once in every 3 steps."],
            "stays": [],
            "ends": [],
            "ends_if_replaced": [],
            "begun": [],
            "ended": [],
            "orders": [],
            "version": reported["version"],
        }
        # At step 2 sensor 3 is due, and its queue is the shortest.
        assert client.post("/decide", json=report(step=2)).json()["sensor_id"] != 3
        assert client.post("/missions/test/guidance", json={"answer": "confirm"}).json()["status"] == "confirmed"
        assert client.post("/decide", json=report(step=2)).json()["sensor_id"] == 3
        assert client.post("/missions/test/guidance", json={"answer": "reject"}).json()["status"] == "rejected"
        assert client.post("/decide", json=report(step=2, uav_id=1)).json()["sensor_id"] != 3
        # Compiled once, and the same PUT again compiles nothing.
        client.put("/missions/test", json={"mode": "value", "note": NOTE})
    [body] = scribe.asked
    assert body["messages"][-1] == {"role": "user", "content": NOTE}
    assert f'"{ORDERS}"' in body["grammar"]


def test_orders_that_do_not_stand_up_are_drawn_again(edge: Edge) -> None:
    scribe = Scribe("visit sensor 8 every 3 steps", "visit sensor 3 at once", ORDERS)
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        client.put("/missions/test", json={"note": NOTE})
        assert guidance(client, "proposed")["in_words"] == "Visit sensor 3 at least once in every 3 steps."
    assert [body["temperature"] for body in scribe.asked] == [0.0, 0.7, 0.7]


@pytest.mark.parametrize(
    ("note", "orders", "why"),
    [
        (NOTE, "visit sensor 8 every 3 steps", "the orders use the number 8"),
        ("Look at sensor 42 every 3 steps", "visit sensor 42 every 3 steps", "sensor 42 is unknown"),
        ("Between 9 and 8 m/s", "fly at least 9 m/s, fly at most 8 m/s", "no velocity is left"),
        (NOTE, "", "is no order"),
        ("Be careful", ORDERS, "has no number"),
    ],
)
def test_what_cannot_be_made_sense_of_fails_and_the_operators_own_still_counts(
    edge: Edge, note: str, orders: str, why: str
) -> None:
    with serving(Scribe(orders).app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        client.put("/missions/test", json={"note": note})
        reported = guidance(client, "failed")
        assert why in reported["failure"] and reported["guidance"] is None
        nothing = client.post("/missions/test/guidance", json={"answer": "confirm"})
        assert (nothing.status_code, fields(nothing)) == (409, ["answer"])
        own = client.post("/missions/test/guidance", json={"guidance": OWN}).json()
    assert (own["status"], own["origin"], own["failure"]) == ("confirmed", "operator", None)
    assert own["guidance"]["max_velocity"] == 5


def test_without_an_llm_the_operators_own_structure_is_obeyed(edge: Edge, report: Report) -> None:
    client = edge()
    client.put("/missions/test", json={"note": NOTE})
    assert "the LLM is off" in guidance(client, "failed")["failure"]
    assert client.post("/missions/test/guidance", json={"guidance": OWN}).status_code == 200
    answers = [client.post("/decide", json=report(step=step, uav_id=u)).json() for step in range(4) for u in range(3)]
    assert all(1 <= answer["velocity"] <= 5 for answer in answers)
    assert {answer["step"] for answer in answers if answer["sensor_id"] == 1} >= {1, 3}


def test_a_mission_without_a_note_takes_guidance_too(edge: Edge, report: Report) -> None:
    client = edge()
    client.post("/decide", json=report())
    assert client.get("/missions/test/guidance").json()["status"] == "none"
    assert client.post("/missions/test/guidance", json={"guidance": OWN}).json()["note"] is None


def test_a_decision_does_not_wait_for_the_note(edge: Edge, report: Report) -> None:
    scribe = Scribe(ORDERS)
    scribe.gate.shut()
    with serving(scribe.app) as url, scribe.gate:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"note": NOTE})
        answer = client.post("/decide", json=report()).json()
        assert answer["source"] == "llm"
        assert client.get("/missions/test/guidance").json()["status"] == "compiling"
        # The operator's own is heard meanwhile, and what the LLM says later is not.
        assert client.post("/missions/test/guidance", json={"guidance": OWN}).json()["status"] == "confirmed"


@pytest.mark.parametrize(
    "note", ["", "   ", "two\nparagraphs", "tab\tbed", "bell\x07", "x" * 281, "hidden\u200btext", "line\u2028break"]
)
def test_a_note_is_one_short_printable_paragraph(edge: Edge, note: str) -> None:
    client = edge()
    response = client.put("/missions/test", json={"note": note})
    assert (response.status_code, fields(response)) == (422, ["note"])
    assert client.get("/missions/test").status_code == 404


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"guidance": {"sensors": [{"sensor_id": 10, "weight": 2}]}}, "guidance.sensors[0].sensor_id"),
        ({"guidance": {"sensors": [{"sensor_id": 1, "weight": 11}]}}, "guidance.sensors[0].weight"),
        ({"guidance": {"sensors": [{"sensor_id": 1, "visit_every": 0}]}}, "guidance.sensors[0].visit_every"),
        ({"guidance": {"forbidden_velocities": list(range(15))}}, "guidance.forbidden_velocities"),
        ({"guidance": {"max_velocity": 15}}, "guidance.max_velocity"),
        ({"answer": "perhaps"}, "answer"),
    ],
)
def test_a_structure_that_cannot_be_obeyed_is_refused_and_changes_nothing(
    edge: Edge, report: Report, body: dict[str, Any], field: str
) -> None:
    client = edge()
    client.post("/decide", json=report())
    client.post("/missions/test/guidance", json={"guidance": OWN})
    before = client.get("/missions/test/guidance").json()
    response = client.post("/missions/test/guidance", json=body)
    assert response.status_code == 422
    assert field in fields(response)
    assert client.get("/missions/test/guidance").json() == before


def test_guidance_of_an_unknown_mission_is_not_found(edge: Edge) -> None:
    client = edge()
    assert client.get("/missions/none/guidance").status_code == 404
    assert client.post("/missions/none/guidance", json={"answer": "confirm"}).status_code == 404


def test_an_llms_answer_at_a_forbidden_velocity_is_refused(edge: Edge, report: Report) -> None:
    with serving(Scribe(ORDERS, answer="0 7").app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        assert client.post("/decide", json=report()).json()["source"] == "llm"
        client.post("/missions/test/guidance", json={"guidance": {"forbidden_velocities": [7, 14]}})
        answers = [client.post("/decide", json=report(step=step)).json() for step in range(1, 5)]
    assert {answer["reason"] for answer in answers} == {"answer_velocity"}
    assert not {answer["velocity"] for answer in answers} & {7, 14}


@pytest.mark.parametrize("mode", ["llm", "guided", "value", "policy"])
@pytest.mark.parametrize("allowed", [[3], [0, 9]])
def test_no_mode_flies_what_is_forbidden(edge: Edge, report: Report, mode: str, allowed: list[int]) -> None:
    with serving(Scribe(ORDERS, answer="0 7").app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": mode})
        forbidden = sorted(set(range(15)) - set(allowed))
        client.post("/missions/test/guidance", json={"guidance": {"forbidden_velocities": forbidden}})
        asked = [report(step=step, uav_id=u) for step in range(3) for u in range(3)]
        answers = [client.post("/decide", json=body).json() for body in asked]
    assert {answer["velocity"] for answer in answers} <= set(allowed)


def test_the_note_stands_in_the_static_block_and_nothing_else_changes() -> None:
    plain, noted = Template(PAPER).static, Template(PAPER, note=NOTE).static
    assert noted.replace(f"The operator's note, to be obeyed: {NOTE}\n\n", "") == plain
    kinds: dict[str, Any] = {"rows": 5, "experiences": 8, "ranked": True}
    plain, noted = GuidedTemplate(PAPER, **kinds).static, GuidedTemplate(PAPER, **kinds, note=NOTE).static
    assert noted.replace(f"The operator's note, to be obeyed: {NOTE}\n\n", "") == plain
    for mode in ("llm", "guided"):
        made = Mission("test", MissionSpec(note="at {sensor} {0}"), Settings(mode=mode, llm_adapter="off"))
        assert "to be obeyed: at {sensor} {0}\n" in made.template.static


def test_a_note_that_the_context_cannot_hold_is_refused(edge: Edge) -> None:
    client = edge(mode="llm", llm_url="http://127.0.0.1:9/v1", llm_context=2500)
    assert client.put("/missions/a", json={}).status_code == 200
    # Four bytes a character, and a token each at the worst.
    refused = client.put("/missions/b", json={"note": "\U0001f6a8" * 280})
    assert (refused.status_code, fields(refused)) == (422, ["prompt"])


def guided_by(structure: Guidance, **spec: Any) -> Mission:
    made = mission(MissionSpec(**spec))
    made.answer_guidance(GuidanceAnswer(guidance=structure))
    return made


def test_a_heavier_sensor_is_scored_higher_and_others_are_as_before() -> None:
    before = {c.sensor_id: c.score for c in attended(mission(MissionSpec(top_k=6)), uav()).candidates}
    heavy = guided_by(Guidance(sensors=[SensorWish(sensor_id=1, weight=5.0)]), top_k=6)
    after = {c.sensor_id: c.score for c in attended(heavy, uav()).candidates}
    assert after.pop(1) > before.pop(1)
    assert after == before


def test_guidance_that_asks_for_nothing_changes_nothing() -> None:
    view, other = attended(mission(), uav()), attended(guided_by(Guidance()), uav())
    assert other.guidance is None
    assert view.candidates == other.candidates


def test_the_policy_prefers_an_overdue_sensor_in_reach_at_a_velocity_that_is_allowed() -> None:
    made = guided_by(Guidance(sensors=[SensorWish(sensor_id=0, visit_every=2)], min_velocity=2, max_velocity=4))
    view = attended(made, uav(step=6), 6)
    free = look_ahead(view.state, view.reach, frozenset())
    asked = look_ahead(view.state, view.reach, frozenset(), view.guidance)
    assert free[0] != 0 and asked[0] == 0 and 2 <= asked[1] <= 4
    # Not if another UAV is on its way to it.
    assert look_ahead(view.state, view.reach, frozenset({0}), view.guidance)[0] != 0


def test_mode_value_flies_the_allowed_velocity_nearest_to_the_one_it_wants() -> None:
    """The best of the learned values among few levels would hover where the best of all flies on."""
    state = uav(step=3)
    wanted = attended(mission(), state, 3).best_by_value()[1]
    for low, high in ((0, 2), (5, 6), (12, 14)):
        made = guided_by(Guidance(min_velocity=low, max_velocity=high))
        assert attended(made, state, 3).best_by_value()[1] == min(max(wanted, low), high)


@pytest.mark.parametrize("asked", [{"visit_every": 1}, {"weight": 10.0}])
def test_the_critic_counts_what_the_operator_asks(asked: dict[str, Any]) -> None:
    made = mission()
    made.observe(uav(queue=[55.0, 59.0]), 0)

    def lost(guidance: Guidance) -> NDArray[np.float64]:
        return evaluate(RolloutState.of(made.belief, PAPER, 0, 0, guidance=guidance), [Action(0, 0), Action(1, 0)]).lost

    before, after = lost(Guidance()), lost(Guidance(sensors=[SensorWish.model_validate({"sensor_id": 0, **asked})]))
    assert before[0] > before[1] and after[0] < after[1]


def test_guided_offers_no_forbidden_velocity() -> None:
    made = guided_by(Guidance(min_velocity=3, max_velocity=5), mode="guided")
    state = uav()
    made.observe(state, 0)
    offer = Deliberation.of(attended(made, state)).candidates
    assert {velocity for _, velocity in offer.actions} <= {3, 4, 5}
    assert set(offer.labels.values()) <= set(range(len(offer.actions)))


def test_an_overdue_sensor_out_of_reach_is_not_waited_for() -> None:
    state = attended(mission(), uav(x=[500.0, 5000.0], queue=[10.0, 50.0]), 0).state
    wish = Guidance(sensors=[SensorWish(sensor_id=1, visit_every=1)])
    asked = StepGuidance.of(wish, state, state.reach_ahead(0, PAPER), 9, np.full(10, -1), PAPER)
    assert not asked.due.any()
    assert (asked.worth == 0).all()


async def test_what_is_asked_beside_gives_way_to_decisions_and_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.llm.server.SILENCE_S", 0.0)
    upstream = LlmServer(Settings(mode="llm"), WarmUp("", "", None))
    running: list[str] = []
    finished: list[str] = []

    async def ask(body: dict[str, Any], mission_id: str | None = None) -> Completion:
        name = "note" if "Rewrite" in body["messages"][0]["content"] else "decision"
        running.append(name)
        if running == ["note"]:
            await asyncio.Event().wait()
        finished.append(name)
        return Completion(ORDERS, None, None, None)

    upstream.status = ServerStatus("ready")
    upstream.connection.client = cast(LLMClient, SimpleNamespace(complete=ask))
    upstream.connection._embedded = cast(EmbeddedServer, EMBEDDED)
    note = asyncio.create_task(upstream.rewrite(REWRITING, temperature=0.0, seed=0))
    await soon(lambda: running)
    await upstream.ask("mission", "static", "user", [0], 15)
    assert finished == ["decision"]
    assert (await note).text == ORDERS
    assert (running, finished) == (["note", "decision", "note"], ["decision", "note"])


async def test_what_is_asked_beside_goes_through_at_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.llm.server.SILENCE_S", 0.0)
    upstream = LlmServer(Settings(mode="llm"), WarmUp("", "", None))
    given_up = asked = decided = 0

    async def ask(body: dict[str, Any], mission_id: str | None = None) -> Completion:
        nonlocal given_up, asked, decided
        if "Rewrite" in body["messages"][0]["content"]:
            asked, before = asked + 1, decided
            try:
                # As long as a decision takes that is asked meanwhile, which is for ever where it goes first.
                await soon(lambda: asked > 3 and decided > before)
            except asyncio.CancelledError:
                given_up += 1
                raise
        else:
            decided += 1
        return Completion(ORDERS, None, None, None)

    def asked_times(times: int) -> bool:
        return asked == times

    upstream.status = ServerStatus("ready")
    upstream.connection.client = cast(LLMClient, SimpleNamespace(complete=ask))
    upstream.connection._embedded = cast(EmbeddedServer, EMBEDDED)
    note = asyncio.create_task(upstream.rewrite(REWRITING, temperature=0.0, seed=0))
    for turn in range(1, 5):
        await soon(partial(asked_times, turn))
        await upstream.ask("mission", "static", "user", [0], 15)
    await note
    assert (note.result().text, given_up) == (ORDERS, 3)
