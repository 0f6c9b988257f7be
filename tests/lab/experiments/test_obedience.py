"""The notes and answers of an experiment's operator, and the measures of obedience."""

from __future__ import annotations

from collections.abc import Callable

import httpx
import pytest

from lab.experiments.edges import EdgeAt
from lab.experiments.execution import fly_with_edge
from lab.experiments.flight import flight_key
from lab.experiments.measures import MEASURES
from lab.experiments.obedience import EXPERIMENT
from lab.experiments.operators import Intent, Operator
from lab.experiments.plan import plan
from lab.experiments.schemes import OFF, over_edge
from service.guidance.note_orders import EXAMPLES, admissible
from shared.client.edge_client import EdgeClient
from shared.planning.orders import NO_GUIDANCE, Guidance, SensorWish
from shared.wire.schemas import MissionSpec
from simulator.sites.site import Site
from tests.integration.service.guidance.test_operator_guidance import Scribe
from tests.support.running import serving
from tests.support.stub_llm import wait_for
from tests.support.tiny_flights import TINY, decided, declared, flown, setup

Edge = Callable[..., httpx.Client]

MEANT = Guidance(sensors=[SensorWish(sensor_id=1, visit_every=2)], max_velocity=6)
# A note that only an LLM can read.
NOTE = "The pipe at sensor 1 hums, so somebody should see it every 2 steps; 6 m/s is plenty."
NOTES = (Intent(note=NOTE, meant=MEANT), Intent(note="Slowly.", meant=NO_GUIDANCE))
ORDERS = "visit sensor 1 every 2 steps, fly at most 6 m/s"


def test_deadlines_count_from_the_first_that_can_be_missed() -> None:
    met = MEASURES["deadlines_met_pct"].of
    visits = [decided(0, 1), decided(1, 1, failed=True), decided(3, 1), decided(4, 2)]
    # Steps 1, 3 and 4 of 1..5: in 2 the last visit is two steps ago, and in 5 that of step 3 is.
    assert met(flown(visits, steps=6, meant=MEANT)) == pytest.approx(60)
    assert met(flown(visits, steps=6, meant=NO_GUIDANCE)) is None
    assert met(flown(visits, steps=6)) is None


def test_velocities_and_confirmations_are_shares() -> None:
    flight = flown([decided(0, 1, velocity=6), decided(1, 1, velocity=7)], meant=MEANT, guidance="rejected")
    assert MEASURES["velocities_allowed_pct"].of(flight) == 50
    assert MEASURES["guidance_confirmed_pct"].of(flight) == 0
    assert MEASURES["velocities_allowed_pct"].of(flown([decided(0, 1)])) is None


@pytest.mark.parametrize(
    ("says", "orders", "status"),
    [
        ("nothing", ORDERS, "none"),
        ("note", ORDERS, "proposed"),
        ("agrees", ORDERS, "confirmed"),
        ("agrees", "visit sensor 1 every 2 steps", "rejected"),
        ("agrees", "do as you please", "failed"),
        ("structure", "do as you please", "confirmed"),
    ],
)
def test_an_operator_confirms_only_the_intended_guidance(edge: Edge, says: str, orders: str, status: str) -> None:
    operator = Operator.model_validate({"says": says, "notes": NOTES})
    with serving(Scribe(orders).app) as llm:
        client = edge(mode="llm", llm_url=f"{llm}/v1")
        wait_for(client, "ready")
        with EdgeClient(str(client.base_url), timeout_s=120) as own:
            own.put_mission("test", MissionSpec(note=operator.note(0)))
            assert operator.answer(own, "test", 0) == status
            understood = own.guidance("test").guidance
    assert (understood == MEANT) == (status in ("confirmed", "proposed"))


def test_a_flight_records_its_guidance_and_obeys(edge: Edge) -> None:
    operator = Operator(says="structure", notes=NOTES)
    scheme = over_edge("intent", "intent", mode="value", backing=OFF, operator=operator)
    [planned] = list(plan(declared(scheme), setup(seeds=1)).flights)
    at = EdgeAt(str(edge().base_url), None, lambda: None)
    flight = fly_with_edge(at, planned)
    assert (flight.meant, flight.guidance) == (MEANT, "confirmed")
    assert max(d.velocity for d in flight.decisions) <= 6


def test_an_operators_note_is_part_of_a_flights_key() -> None:
    schemes = [
        over_edge("a", "a", mode="value", backing=OFF, operator=operator)
        for operator in (None, Operator(says="note", notes=NOTES), Operator(says="structure", notes=NOTES))
    ]
    assert len({flight_key(scheme, OFF, Site(TINY), 0) for scheme in schemes}) == 3


def test_every_way_of_telling_is_compared_and_no_note_is_a_worked_example() -> None:
    schemes = {scheme.name: scheme for scheme in EXPERIMENT.schemes(setup())}
    assert {"llm_note", "guided_agrees", "guided_structure", "value_structure", "policy_structure"} <= schemes.keys()
    operator = schemes["guided_agrees"].decides.operator  # type: ignore[union-attr]
    assert operator is not None
    for intent in operator.notes:
        assert intent.note not in dict(EXAMPLES)
        wanted = {wish.visit_every for wish in intent.meant.sensors}
        assert any(f"every {n} steps" in order for n in wanted for order in admissible(intent.note))
