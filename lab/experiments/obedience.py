"""The obedience of a fleet to its operator's note, by the form in which the note reaches the edge."""

from __future__ import annotations

from lab.experiments.measures import LOSSES
from lab.experiments.operators import Intent, Operator
from lab.experiments.plan import Experiment, FigureSpec, Setup
from lab.experiments.schemes import NAMED_BY_OPTION, OFF, Backing, Scheme, adapted_llm, over_edge
from shared.planning.orders import Guidance, SensorWish

# Each has a visit and a rule for velocities, in different wordings; none is a worked example of the edge.
_NOTES = tuple(
    Intent(note=note, meant=Guidance(sensors=[SensorWish(sensor_id=sensor, visit_every=every)], **limits))
    for (sensor, every), limits, note in (
        (
            (4, 3),
            {"max_velocity": 10},
            "Suspected leak at sensor 4: visit it every 3 steps, and fly no faster than 10 m/s.",
        ),
        ((7, 4), {"max_velocity": 9}, "Sensor 7 must be seen every 4 steps. Speed limit 9 m/s."),
        ((2, 5), {"min_velocity": 3}, "Please look in on sensor 2 every 5 steps. Fly at least 3 m/s."),
        ((0, 3), {"forbidden_velocities": [14]}, "Sensor 0 needs a visit every third step. Avoid 14 m/s, it shakes."),
        ((8, 4), {"max_velocity": 11}, "Do not leave sensor 8 alone for more than 4 steps. 11 m/s at most."),
    )
)
_OBEYED = ("deadlines_met_pct", "velocities_allowed_pct")


def _flown(mode: str, says: str, label: str, backing: Backing = NAMED_BY_OPTION) -> Scheme:
    operator = Operator.model_validate({"says": says, "notes": _NOTES})
    return over_edge(f"{mode}_{says}", f"mode {mode}, {label}", mode=mode, operator=operator, backing=backing)


def _adapted(says: str, label: str) -> Scheme:
    operator = Operator.model_validate({"says": says, "notes": _NOTES})
    return adapted_llm(f"llm_adapted_{says}", f"mode llm with the adapter, {label}", operator=operator)


def _schemes(setup: Setup) -> list[Scheme]:
    with_llm = [
        _flown("llm", "nothing", "no note"),
        _flown("llm", "note", "note in the prompt"),
        _adapted("nothing", "no note"),
        _adapted("note", "note in the prompt"),
        _adapted("structure", "operator's structure"),
        _flown("guided", "nothing", "no note"),
        _flown("guided", "note", "note in the prompt"),
        _flown("guided", "agrees", "compiled note, confirmed where right"),
        _flown("guided", "structure", "operator's structure"),
    ]
    without_llm = [
        _flown(mode, says, label, backing=OFF)
        for mode in ("value", "policy")
        for says, label in (("nothing", "no note"), ("structure", "operator's structure"))
    ]
    return [*with_llm, *without_llm]


EXPERIMENT = Experiment(
    name="obedience",
    title="What the operator asks, and what is done",
    summary="an operator's note: not sent, in the prompt, compiled by the LLM, or given as a structure",
    schemes=_schemes,
    measures=(*_OBEYED, "guidance_confirmed_pct", *LOSSES, "failures"),
    figures=(
        FigureSpec(
            "obedience", "bars", _OBEYED, "Visit deadlines met at the sensor named, steps at allowed velocities."
        ),
        FigureSpec("obedience_losses", "bars", LOSSES, "What obeying costs: losses of a mission."),
    ),
    when_quick="no_llm",
    references=("guided_nothing",),
    pairs=(
        ("llm_note", "llm_nothing"),
        ("llm_adapted_note", "llm_adapted_nothing"),
        ("value_structure", "value_nothing"),
        ("policy_structure", "policy_nothing"),
    ),
    paired_measures=(*_OBEYED, "lost_packets"),
    notes=(
        f"{len(_NOTES)} notes, one after another by seed, each with a visit to a sensor and a rule for velocities: "
        + " | ".join(f"“{intent.note}”" for intent in _NOTES),
        "A deadline is met in a step at whose end the named sensor was served within the last n steps, n as asked; "
        "from step n - 1 on. A UAV may begin its mission out of the sensor's reach.",
        "Compiled notes are confirmed only where the LLM's structure is what the note means; else they are "
        "rejected, and the flight goes on with the note in the prompt alone.",
    ),
)
