"""Missions in a store that commit 601e8f2 wrote fly on as they did with its code, to the bit."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest

from tests.e2e.restoring import FLIGHTS, STORE, answers, arithmetic, unlike


@pytest.mark.parametrize("llm", ["drawing", "off"])
def test_a_store_of_601e8f2_flies_on_as_it_did(tmp_path: Path, llm: str) -> None:
    recorded = json.loads(FLIGHTS.read_text())
    told = answers(STORE, recorded["requests"], llm, tmp_path / "missions.db")
    faults = [
        f"{request['method']} {request['path']}, request {number}: {fault}"
        for number, request in enumerate(recorded["requests"])
        for fault in unlike(told[number], recorded["answers"][llm][number], recorded["arithmetic"] == arithmetic())
    ]
    assert faults == []


def test_the_store_has_checkpoints_and_events_after_them() -> None:
    with sqlite3.connect(f"file:{STORE}?mode=ro&immutable=1", uri=True) as db:
        checkpointed = {row[0] for row in db.execute("SELECT mission_id FROM checkpoints")}
        since = dict(db.execute("SELECT mission_id, COUNT(*) FROM journal GROUP BY mission_id"))
        kinds = {row[0] for row in db.execute("SELECT DISTINCT kind FROM journal")}
        missions = {row[0] for row in db.execute("SELECT mission_id FROM missions")}
    db.close()
    # Restored from a checkpoint alone, from events alone, and from both.
    assert checkpointed - since.keys() and since.keys() - checkpointed and since.keys() & checkpointed
    assert missions == checkpointed | since.keys()
    assert kinds == {"reported", "decided", "settled", "guided", "answered"}


def test_another_arithmetic_may_order_a_tie_otherwise_and_nothing_else() -> None:
    one, two, worse = (
        {"sensor_id": j, "velocity": 12, "score": score} for j, score in enumerate((-0.5, -0.5001, -0.9))
    )
    assert unlike([two, one, worse], [one, two, worse], exact=False) == []
    assert unlike([two, one, worse], [one, two, worse], exact=True)
    assert unlike([one, worse, two], [one, two, worse], exact=False)
    # The sensor of a tie must be there.
    assert unlike([one, one, worse], [one, two, worse], exact=False)
