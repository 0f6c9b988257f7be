"""A new note during a mission: compiled anew, and obeyed once it is confirmed."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import cast

from service.config.settings import Settings
from service.guidance.note_compiler import NoteCompiler
from service.llm.server_pool import ServerPool
from service.mission.mission import Mission
from shared.planning.guidance_messages import GuidanceAnswer
from shared.wire.schemas import MissionSpec
from tests.integration.service.guidance.test_operator_guidance import NOTE, ORDERS, OWN, Edge, Scribe, guidance
from tests.support.running import serving
from tests.support.stub_llm import wait_for
from tests.support.waiting import PATIENCE_S, Gate, until


def test_a_new_note_is_compiled_while_the_orders_before_it_stay(edge: Edge) -> None:
    scribe = Scribe(ORDERS, "visit sensor 2 every 4 steps")
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value", "note": NOTE})
        guidance(client, "proposed")
        client.post("/missions/test/guidance", json={"answer": "confirm"})
        new = {"note": "Look at sensor 2 every 4 steps."}
        assert client.post("/missions/test/guidance", json=new).status_code == 200
        reported = guidance(client, "proposed")
        assert (reported["note"], reported["in_words"]) == (
            new["note"],
            "Visit sensor 2 at least once in every 4 steps.",
        )
        assert reported["obeyed_in_words"] == "Visit sensor 3 at least once in every 3 steps."
        # A rejected proposal leaves the orders before it, also where a client sends its answer again.
        for _ in range(2):
            rejected = client.post("/missions/test/guidance", json={"answer": "reject"}).json()
            assert (rejected["status"], rejected["obeyed_in_words"]) == ("rejected", reported["obeyed_in_words"])
        assert client.post("/missions/test/guidance", json={"answer": "withdraw"}).json()["obeyed_in_words"] is None
        # The mission's spec is the same: the PUT that made it changes nothing.
        assert client.put("/missions/test", json={"mode": "value", "note": NOTE}).status_code == 200


def test_a_note_that_comes_while_another_is_compiled_replaces_it(edge: Edge) -> None:
    scribe = Scribe(ORDERS, "visit sensor 2 every 4 steps")
    scribe.gate = Gate()
    with serving(scribe.app) as url:
        client = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(client, "ready")
        client.put("/missions/test", json={"mode": "value", "note": NOTE})
        until(lambda: len(scribe.asked) == 1)
        client.post("/missions/test/guidance", json={"note": "Look at sensor 2 every 4 steps."})
        scribe.gate.open()
        assert guidance(client, "proposed")["in_words"] == "Visit sensor 2 at least once in every 4 steps."


def test_an_answer_is_one_of_three(edge: Edge) -> None:
    client = edge()
    client.put("/missions/test", json={})
    for body in ({}, {"answer": "confirm", "note": NOTE}, {"guidance": OWN, "note": NOTE}):
        refused = client.post("/missions/test/guidance", json=body)
        assert refused.status_code == 422 and "one of answer, guidance and note" in refused.json()["detail"]
    assert client.post("/missions/test/guidance", json={"note": "x" * 281}).status_code == 422


def test_a_note_that_the_llm_must_read_keeps_no_other_waiting(edge: Edge) -> None:
    """The LLM is gone: the first note waits for it, and the operator's next words are read by code."""
    client = edge(mode="llm", llm_url="http://127.0.0.1:9/v1")
    waits = "Somebody should keep half an eye on sensor 4 please."
    client.put("/missions/test", json={"mode": "value", "note": waits})
    client.put("/missions/other", json={"mode": "value"})
    assert client.post("/missions/other/guidance", json={"guidance": OWN}).status_code == 200
    client.post("/missions/other/guidance", json={"note": "cancel all orders"})
    until(lambda: client.get("/missions/other/guidance").json()["status"] == "proposed")
    assert guidance(client, "compiling")["note"] == waits
    client.post("/missions/test/guidance", json={"note": "visit sensor 2 every 4 steps"})
    assert guidance(client, "proposed")["in_words"] == "Visit sensor 2 at least once in every 4 steps."


def test_the_spaces_of_other_languages_are_spaces(edge: Edge) -> None:
    client = edge()
    note = "Visit\u00a0sensor 3 every\u202f4\u3000steps."
    assert client.put("/missions/test", json={"note": note}).status_code == 200
    assert guidance(client, "proposed")["note"] == "Visit sensor 3 every 4 steps."


def test_a_note_that_comes_just_as_the_one_before_it_is_compiled_is_compiled_too() -> None:
    mission = Mission("test", MissionSpec(note="visit sensor 4 every 3 steps"), Settings(mode="policy"))

    async def compiled() -> None:
        def give(_: str) -> None:
            # A request that is answered between the last step of the note's task and its callbacks.
            compiler._on_change = lambda _: None
            asyncio.get_running_loop().call_soon(post)

        def post() -> None:
            mission.answer_guidance(GuidanceAnswer(note="visit sensor 5 every 3 steps"))
            compiler.compile(mission)

        compiler = NoteCompiler(cast(ServerPool, SimpleNamespace(status="off", recovering=False)), give)
        compiler.compile(mission)
        async with asyncio.timeout(PATIENCE_S):
            while mission.guidance.status != "proposed" or "5" not in (mission.guidance.note or ""):
                await asyncio.sleep(0.01)

    asyncio.run(compiled())
