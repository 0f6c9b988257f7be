"""What the event loop calls is compiled before the edge is ready, in one form."""

from __future__ import annotations

from pathlib import Path

from service.edge.compilation import load_for_event_loop
from shared.belief import arrivals, link_expectations
from shared.belief.fleet_belief import FleetBelief
from shared.belief.records import take_report
from shared.features.augmented_state import augment
from tests.integration.shared.belief.test_belief_updates import WORLD, flown, report


def test_no_form_of_an_array_is_compiled_anew_once_the_edge_is_ready() -> None:
    """On the event loop every decision would wait for the compiler."""
    functions = [
        arrivals.take_beacons,
        arrivals.take_arrivals,
        arrivals.in_range,
        link_expectations.measured_excess,
        link_expectations.expected_transfers,
        link_expectations.transfer,
        link_expectations.know_rings,
        link_expectations.formula_transfers,
    ]
    load_for_event_loop()
    assert {function.__name__: len(function.signatures) for function in functions} == {  # type: ignore[attr-defined]
        function.__name__: 1 for function in functions
    }
    belief, records = flown(60)
    again = FleetBelief(WORLD)
    again.load_state_dict(belief.state_dict())
    for step in range(60, 64):
        take_report(report(step), step, records, again)
        for known, rates in ((again, None), (None, records.rates)):
            augment(
                report(step), step, WORLD, visits=records.visits, rates=rates, reserved=(), preset="reach", belief=known
            )
        again.record_decision(step % 2, step, 0, 3)
        again.settle(step % 2, step, failed=False)
    assert {len(function.signatures) for function in functions} == {1}  # type: ignore[attr-defined]


def test_the_compilers_code_does_not_stay_in_memory() -> None:
    """Most of what a compiler needs, no edge needs once its functions are loaded."""
    resident_kb, counts = 0, False
    load_for_event_loop()
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        field, *values = line.split()
        if "-" in field:
            counts = values[0] in ("r-xp", "r--p") and values[-1].endswith("libllvmlite.so")
        elif counts and field == "Rss:":
            resident_kb += int(values[0])
    # All of it is 100 MB, and compiling touches 70 MB.
    assert resident_kb < 15_000
    assert FleetBelief(WORLD).channel.transfer(0.0)[1] > 0
