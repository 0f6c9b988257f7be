import pytest

from service.mission.decisions import AppliedOutcomes, Reservation, Reservations


def test_what_was_applied_is_known_with_its_sign_and_its_zero() -> None:
    applied = AppliedOutcomes(most=3)
    reported = [
        ("0" * 31 + str(n), cost, failed) for n, (cost, failed) in enumerate([(0.0, True), (0.0, False), (2.5, True)])
    ]
    for one in reported:
        applied.add(*one)
    assert [applied[name] for name, *_ in reported] == [(cost, failed) for _, cost, failed in reported]
    again = AppliedOutcomes(most=3)
    again.load_state_dict(applied.state_dict())
    assert again.state_dict() == reported


def test_a_cost_of_minus_zero_is_no_failure() -> None:
    applied = AppliedOutcomes(most=1)
    applied.add("0" * 32, -0.0, False)
    assert applied["0" * 32] == (0.0, False)


def test_the_oldest_is_forgotten() -> None:
    applied = AppliedOutcomes(most=2)
    for n in range(3):
        applied.add(f"{n:032x}", 1.0, False)
    assert [f"{n:032x}" in applied for n in range(3)] == [False, True, True]
    with pytest.raises(KeyError):
        applied[f"{0:032x}"]


def test_the_newest_decision_is_the_latest_that_is_not_in_the_future() -> None:
    given = Reservations()
    assert given.newest_at(1e9) is None
    # The first 12 digits are milliseconds; of an earlier version's ID they are random.
    for uav, milliseconds in enumerate((5_000, 7_250, 0xF00000000000)):
        given.reserve(uav, Reservation(uav, uav, f"{milliseconds:012x}{'0' * 20}", 1))
    assert [given.newest_at(now) for now in (4.0, 6.0, 7.25, 1e9)] == [None, 5.0, 7.25, 7.25]
