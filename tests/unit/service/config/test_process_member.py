"""Which process decides a mission."""

from collections import Counter

from service.config.process_member import slot_of

MISSIONS = [f"mission-{number}" for number in range(2000)]


def test_it_never_changes() -> None:
    """Processes of different versions, and those of other machines, must agree."""
    assert [slot_of(name, 4) for name in ("default", "fleet-1", "a", "Überflug")] == [0, 2, 3, 1]


def test_the_missions_are_shared_out_evenly() -> None:
    for slots in (2, 3, 8):
        shares = Counter(slot_of(name, slots) for name in MISSIONS)
        assert sorted(shares) == list(range(slots))
        # Four standard deviations of an even draw.
        assert all(abs(n - 2000 / slots) < 4 * (2000 / slots) ** 0.5 for n in shares.values())


def test_one_process_more_takes_missions_and_moves_no_other() -> None:
    for slots in (1, 2, 5):
        moved = [name for name in MISSIONS if slot_of(name, slots) != slot_of(name, slots + 1)]
        assert moved and all(slot_of(name, slots + 1) == slots for name in moved)
