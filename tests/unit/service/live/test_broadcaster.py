"""How often a mission's page gets an update."""

import pytest

from service.live.broadcaster import pause_s


@pytest.mark.parametrize(
    ("took_s", "pause"),
    [
        (0.0, 0.1),
        (0.04, 0.8),
        # A kernel that is compiled, or a machine that was suspended, in mid-update.
        (9.0, 2.0),
        (3600.0, 2.0),
    ],
)
def test_updates_take_a_small_share_of_the_event_loop_and_go_on_after_a_stall(took_s: float, pause: float) -> None:
    assert pause_s(took_s) == pytest.approx(pause)
