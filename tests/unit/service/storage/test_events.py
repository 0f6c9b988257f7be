"""Every kind of event in the journal is read as it was written."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from service.learning.modules import Sample
from service.learning.trust import Advice
from service.mission.decisions import Pending
from service.mission.events import AdviserReport, Decided, Event, GuidanceChanged, ReadingsMerged, Settled
from service.mission.idempotency import Answered
from service.mission.sensor_readings import PlacedReading
from service.storage.rows import decode, encode, pack, unpack
from shared.wire.schemas import Outcome

ID = "a" * 32
ADVICE = Advice({"llm": 0.5, "policy": 0.0}, {"llm": 0.25, "policy": 1.0}, 1.5)


def read(event: Event) -> Any:
    return decode(*encode(event))


@pytest.mark.parametrize("failed", [True, False])
@pytest.mark.parametrize("for_training", [True, False])
def test_an_outcome_keeps_its_cost_its_failure_and_its_training(failed: bool, for_training: bool) -> None:
    outcome = Outcome(decision_id=ID, cost=1.25, failed=failed)
    assert read(Settled(outcome, for_training)) == Settled(outcome, for_training)


@pytest.mark.parametrize("report", [None, AdviserReport("model", ADVICE)])
def test_a_decision_keeps_its_sample_to_the_bit_and_its_advice(report: AdviserReport | None) -> None:
    sample = Sample(
        np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4), 2, np.array([0.1, -0.0, np.inf], np.float32), 7
    )
    found = read(Decided(Pending(ID, 2, 30, 4, 7, (), sample), 3, report))  # type: ignore[arg-type]
    assert (found.attempt, found.advice) == (3, report)
    assert found.decision[:5] == (ID, 2, 30, 4, 7)
    read_sample = found.decision.sample
    for written, again in ((sample.features, read_sample.features), (sample.approach, read_sample.approach)):
        assert (again.dtype, again.shape, again.tobytes()) == (written.dtype, written.shape, written.tobytes())
        # Training and the belief write into the restored arrays.
        assert again.flags.writeable
    assert (read_sample.chosen, read_sample.velocity) == (2, 7)


def test_an_answer_guidance_and_readings_are_kept() -> None:
    for event in (
        Answered("key", "digest", "answer"),
        ReadingsMerged([PlacedReading(4, -3, 12.0, None, "id"), PlacedReading(5, 7, 0.0, 41.5, None)]),
        GuidanceChanged({"note": "Visit 4", "values": {"visit:4": 3.0}, "numbers": [1, None, True]}),
    ):
        assert read(event) == event


@pytest.mark.parametrize("at", [0, 5, -1])
def test_a_changed_byte_is_damage(at: int) -> None:
    data = bytearray(pack({"values": [1, 2, 3], "array": np.arange(4)}))
    unpack(bytes(data))
    data[at] ^= 1
    with pytest.raises(ValueError, match="damaged bytes"):
        unpack(bytes(data))
