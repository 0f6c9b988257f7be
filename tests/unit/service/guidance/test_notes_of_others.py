"""Notes that others wrote and that were once read wrongly, or refused: slips, reasons, conditions, spellings."""

from __future__ import annotations

import pytest

from service.guidance.note_orders import BadOrders
from shared.planning.orders import NO_GUIDANCE, Guidance
from tests.unit.service.guidance.test_note_phrases import phrased


@pytest.mark.parametrize(
    ("note", "read"),
    [
        ("pls chekc on snesor 0 evry other step", "pls check on sensor 0 every other step"),
        ("wieght of nr 9: x5", "weight of number 9: 5 times"),
        ("Sensor 2 quadruple, sensor 7 tenfold", "Sensor 2 4 times, sensor 7 ten times"),
        ("Weigh it at a quarter, it doesnt matter", "Weigh it at 0.250 times, it doesn't matter"),
        ("H2S at sensor 2, see it every minute and a half", "gas at sensor 2, see it every 1.5 minutes"),
        ("all three drones below 9 m/s, we need one reading", "all drones below 9 m/s, we need a reading"),
        ("Avoid 5 and 7 m/s, these two speeds shake", "Avoid 5 and 7 m/s, these speeds shake"),
        ("Count it a fifth as much as sens 4", "Count it 0.200 times as much as sensor 4"),
        ("The 75 mbar line is dug up, job no. 5591", "The pipe line is dug up, ticket"),
        ("Visit sensor 4 above 5 bar", "Visit sensor 4 above 5 bar"),
        ("We permit 8 m/s, case 4 and job 7", "We permit 8 m/s, case 4 and job 7"),
        ("Twenty steps may pass between two calls on sensor 6", "twenty steps may pass between calls on sensor 6"),
        ("7 every min n a half, 6 every 2 and a half mins", "7 every 1.5 minutes, 6 every 2.5 mins"),
        ("Interval two minutes thirty, then one minute forty", "Interval 2.5 minutes, then 100 seconds"),
        ("3 visits in the hour for 5, twice a min for 1", "every 20 minutes for 5, every 30 seconds for 1"),
        ("Between 15 and 30 mph", "Between 15 mph and 30 mph"),
        ("22 knots at most and 6 at least", "22 knots at most and 6 knots at least"),
        ("Nae slower than 15 kmph nor faster than 45", "Nae slower than 15 km/h nor faster than 45 km/h"),
        ("4 every seventy seconds, 0 every hundred", "4 every seventy seconds, 0 every 100 seconds"),
        ("Weights of 4 and 8: 50 and 75 percent", "Weights of 4 and 8: 50 percent and 75 percent"),
        ("8 is worth a mere fifth, 2 three quarters", "8 is worth 0.200 times, 2 0.750 times"),
        ("sensor 6 weighs 0,5 and 7 one point eight", "sensor 6 weighs 0.5 and 7 1.8"),
        ("Min speed raised from 3 to 6 m/s", "Min speed raised to 6 m/s"),
        ("Sensor 2 goes from every 90 seconds to every 50.", "Sensor 2 goes to every 50 seconds."),
        ("Fly from 3 to 6 m/s", "Fly from 3 to 6 m/s"),
        ("4 every 3 steps... no wait, every 5 steps", "4 every 5 steps"),
        ("Sensor 4 back to normal weight", "Sensor 4 back to weight 1"),
        ("Sensor 4 twice the normal weight", "Sensor 4 twice the normal weight"),
        ("Minus 27 outside. 9 kids here, $300 gone", "cold. some kids here, money gone"),
        ("Sensor 4 people like", "Sensor 4 people like"),
        ("The bus is at marker 212 again. Sensor 4 every 3 steps for me", "sensor 4 every 3 steps for me"),
        ("S3 must wait. 40 visitors or more", "S3 must wait. some visitors or more"),
        # A time, an end and a height stay.
        ("Sensor 4 every 3 steps, from 1540 on", "Sensor 4 every 3 steps, from 1540 on"),
        ("Sensor 4 every 3 steps for 3 days", "Sensor 4 every 3 steps for 3 days"),
        ("Stay above 40 feet", "Stay above 40 feet"),
    ],
)
def test_other_spellings_and_slips_are_read_as_usual_words(note: str, read: str) -> None:
    assert phrased(note).text == read


@pytest.mark.parametrize(
    "note",
    """\
UAV 2 motors are hot, keep below 8 m/s.
Sensor 5 every 3 minutes, wait 2 minutes before the first visit.
Visit all sensors minus 5 every 4 steps.
Sensor 4 counts like before, sensor 5 counts double.
Sensor 3 gets less than its normal weight
Raise the weight of sensor 3 by a quarter.
Raise sensors from 3 to 7 to weight 2.
Shift the weight from 3 to 7.
Cut speeds from 4 to 6 m/s out.
Fly up from 4 to 9 m/s.
Once 3 falls silent ignore it
Second drone: no hovering.
The sign at the gate says: no hovering.
Nice work, keep it moving!
Visit sensor 3 every 6 and 20 km/h max
Visit sensor 3 every 1 minute 10 m/s max
Give sensor one two minutes.
Visit sensor one four steps at the latest
Point three every 5 steps.
Double the weights of 3,5 and 7.
Sensor 3 is a third more important.
Sensor 2 lost three quarters of its battery, see it every 4 steps.
Visit 3 every 2 minutes and 4 every 5 steps, 5 every 6.
Sensor 3 weighs half, sensor 4 halved again.
Sensor 3 not back to normal weight yet.
Move from 3 to 8 m/s at most.
Sensor 4 every 3 steps. Window 1400-1600.
Sensor 4 every 3 steps. Wait for the 16th flight.
Sensor 4 every twenty-two minutes thirty seconds
Sensor 4 weighs one point two five
Sensor 3 every 3 steps, data not more than 2 days old
Limit 25 mph, temperatures below 5.""".splitlines(),
)
def test_what_may_mean_a_sensor_or_a_range_stays(note: str) -> None:
    assert (phrased(note).text, phrased(note).orders) == (note, False)


@pytest.mark.parametrize(
    ("note", "doubt"),
    [
        ("Visit sensor 3 every 6 steps. Wait 30 seconds there.", "wait 30 seconds there"),
        ("Visit sensor 3 every 4 steps, ending 1900 local.", "ending 1900 local"),
        ("Visit sensor 4 every 5 steps. Keep 100 metres off the road.", "keep 100 metres off the road"),
        ("Visit sensor 3 every 5 steps, take 20 pictures.", "take 20 pictures"),
        ("Visit sensor 4 every 5 steps, finish in 20 laps.", "finish in 20 laps"),
    ],
)
def test_what_no_order_has_leaves_a_doubt(note: str, doubt: str) -> None:
    assert phrased(note).completed(NO_GUIDANCE, ())[1] == [f"In no order: “{doubt}”."]


def test_a_condition_that_is_a_denial_is_quoted() -> None:
    with pytest.raises(BadOrders, match="asks or has a condition"):
        phrased("Visit sensor 3 every 4 steps if it is not dark.").completed(NO_GUIDANCE, ())


@pytest.mark.parametrize(
    ("note", "read"),
    [
        ("The valve by sensor 8 was repaired. I want it inspected every half minute.", {"visit:8": 3}),
        ("Oil film seen at sensor 6. I need eyes on it every 4 steps.", {"visit:6": 4}),
        ("Anywhere from 3 to 10 m/s is fine by me.", {"min_velocity": 3, "max_velocity": 10}),
        ("Keep it moving: 4 m/s or more, everyone.", {"min_velocity": 4}),
        ("Sensor 0 delivers only noise; please disregard it.", {"weight:0": 0}),
        ("Could we give sensor 6 a weight of 2.25 times the usual?", {"weight:6": 2.25}),
        ("Is it possible to give sensor 7 a weight of 6?", {"weight:7": 6}),
        ("Would it be ok if the drones fly with maximum 6 m/s?", {"max_velocity": 6}),
        ("Go to sensor 9 every 6 steps, they hit anything slow.", {"visit:9": 6}),
    ],
)
def test_reasons_and_politeness_leave_no_doubt(note: str, read: dict[str, float]) -> None:
    meant = Guidance.of(read, {})
    assert phrased(note).completed(meant, {0.5, 8.0, 7.0, 6.0, 4.0, 9.0, *read.values()}) == (meant, [])


@pytest.mark.parametrize(
    ("note", "read"),
    [
        ("UAV 2 alone should slow down to 5 m/s.", {"max_velocity": 5}),
        ("UAV 1 looks after sensor 6 every 3 steps.", {"visit:6": 3}),
        ("Only UAV 2 goes to sensor 5, the others stay away.", {f"weight:{sensor}": 0 for sensor in range(5)}),
    ],
)
def test_what_one_uav_should_do_is_no_order(note: str, read: dict[str, float]) -> None:
    with pytest.raises(BadOrders, match="may end an order or mean a part of the fleet"):
        phrased(note).completed(Guidance.of(read, {}), {2.0, *read.values()})


def test_a_condition_with_a_number_is_quoted() -> None:
    with pytest.raises(BadOrders, match="asks or has a condition"):
        phrased("If the wind picks up beyond 40 km/h, slow down to 5 m/s.").completed(NO_GUIDANCE, ())


def test_an_order_is_not_taken_out_of_a_sentence_that_goes_on_about_its_sensor() -> None:
    assert not phrased("Go to sensor 9 every 6 steps and let its losses count fivefold.").orders
    assert phrased("Go to sensor 9 every 6 steps and stay below 5 m/s.").orders
