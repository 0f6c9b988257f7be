"""The bounded memory of decisions and of updates after a mission is deleted, or its sensors have moved."""

from __future__ import annotations

from service.live.broadcaster import Broadcaster
from service.live.recent_decisions import RecentDecisions
from tests.integration.service.live.test_broadcaster import answer_of, prompt_of
from tests.support.missions import mission, uav


def test_the_prompts_of_a_deleted_mission_take_no_space_from_others() -> None:
    history, prompt = RecentDecisions(), prompt_of("x" * 20_000)
    for number in range(150):
        history.decided((0.0, 0.0), prompt, answer_of(f"{number:032x}", "deleted"))
    history.forget("deleted")
    for number in range(150):
        history.decided((0.0, 0.0), prompt, answer_of(f"{number:032x}", "kept"))
    assert [one.prompt is None for one in history.of("kept")] == [False] * 150


def test_decisions_past_the_number_kept_take_no_space_from_later_prompts() -> None:
    history, long, short = RecentDecisions(), prompt_of("x" * 20_000), prompt_of("")
    for number, prompt in enumerate([long] * 150 + [short] * 600 + [long] * 150):
        history.decided((0.0, 0.0), prompt, answer_of(f"{number:032x}"))
    assert all(one.prompt is not None for one in history.of("test"))


async def test_after_sensors_have_moved_a_page_gets_updates_and_not_snapshots_again() -> None:
    live, fleet = Broadcaster(), mission()
    fleet.observe(uav(), 0)
    # Updates of half the bytes that are kept for late listeners.
    live.watch.of("test").silent.update(dict.fromkeys(range(45_000), 0))
    events, names = live.events(fleet), []
    for step in range(5):
        if step == 3:
            fleet.observe(uav(step=3, x=[800.0 + 10.0 * number for number in range(6)]), 3)
        names.append((await anext(events)).split(b"\n")[0].decode())
        live.changed("test")
    await events.aclose()
    assert names == ["event: snapshot", "event: update", "event: update", "event: snapshot", "event: update"]
