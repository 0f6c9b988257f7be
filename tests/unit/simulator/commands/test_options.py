"""The checks of the options that several commands share."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from simulator.commands.options import check_between, check_deadline, check_seed, check_wait, edge_from_option
from simulator.errors import UsageError


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: check_seed(2**32), "--seed 4294967296 is not between 0 and 4294967295"),
        (lambda: check_seed(-1), "--seed -1 is not between 0 and 4294967295"),
        (lambda: check_wait(90_000.5), "--wait-s 90000.5 is not between 0 and 86400"),
        (lambda: check_wait(float("nan")), "--wait-s nan is not between 0 and 86400"),
        (lambda: check_deadline(9), "--deadline-ms 9 is not between 10 and 60000"),
        (lambda: check_between("--time-limit-s", 0.0, 0.1, 86_400), "--time-limit-s 0 is not between 0.1 and 86400"),
        (lambda: edge_from_option(None), "--edge is missing: give the edge's address"),
        (lambda: edge_from_option("ftp://edge"), "--edge: "),
    ],
)
def test_the_error_for_a_value_out_of_bounds_has_the_bounds(check: Callable[[], object], message: str) -> None:
    with pytest.raises(UsageError) as error:
        check()
    assert str(error.value).startswith(message)


def test_values_on_their_bounds_are_taken() -> None:
    check_seed(0)
    check_seed(2**32 - 1)
    check_wait(86_400)
    check_deadline(None)
    check_deadline(10)
    assert edge_from_option("http://127.0.0.1:8000").startswith("http://127.0.0.1:8000")
