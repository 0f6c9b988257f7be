"""The visiting record of a sensor: visits that are presumed, confirmed and withdrawn, in any order."""

from __future__ import annotations

from shared.belief.records import Records
from shared.world.scenario import Scenario


def test_a_visit_that_is_confirmed_late_does_not_replace_a_later_one() -> None:
    records = Records(Scenario())
    for decision, step in (("later", 7), ("earlier", 3)):
        records.presume(4, decision, step)
        records.confirm(4, decision, step)
    assert (records.visits[4], records.confirmed[4]) == (7, 7)


def test_a_visit_that_failed_leaves_the_latest_of_the_others() -> None:
    records = Records(Scenario())
    records.presume(4, "confirmed", 2)
    records.confirm(4, "confirmed", 2)
    for decision, step in (("open", 5), ("fails", 8)):
        records.presume(4, decision, step)
    found = [int(records.visits[4])]
    for decision in ("fails", "open"):
        records.withdraw(4, decision)
        found.append(int(records.visits[4]))
    assert found == [8, 5, 2] and records.confirmed[4] == 2
