"""A second reading of a note, by rules: each number's part in the orders by the words beside it.

``plain_reading.toml`` has the words. The rules read nothing rather than guess, and err for other reasons than the LLM:
where both read the same, the reading is certain. Else words may confirm the LLM's.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files

from service.guidance.lettered_orders import METRES_A_SECOND, ROUNDING, SECONDS
from service.guidance.note_numbers import numbers_of
from shared.world.scenario import MAX_SENSORS, Scenario

_TABLE = tomllib.loads(files("service.guidance").joinpath("plain_reading.toml").read_text(encoding="utf-8"))
_WORDS = {kind: re.compile("|".join(patterns)) for kind, patterns in _TABLE["words"].items()}
_CONFIRMS = {kind: re.compile("|".join(patterns)) for kind, patterns in _TABLE["confirms"].items()}
_BESIDE = {kind: (re.compile(row["before"]), re.compile(row["after"])) for kind, row in _TABLE["beside"].items()}
_SPEEDS = {unit: factor for unit, factor in METRES_A_SECOND.items() if unit}
_LIMITS = {"most": "max_velocity", "least": "min_velocity", "avoided": "avoid:{:g}"}
_Orders = Iterator[tuple[str, float]]


@dataclass(slots=True)
class _Part:
    """A number's part in the orders, ``sensor``, ``visit``, ``weight`` or ``velocity``, and where it stands.

    ``values`` are the IDs of sensors, or one number: steps, a factor, or m/s.
    """

    kind: str
    values: list[float]
    begin: int
    end: int


def plain_reading(note: str, scenario: Scenario) -> dict[str, float] | None:
    """Each order's value by its name; None if the rules do not know a number's part, or a word asks for more."""
    text = _WORDS["aside"].sub(lambda found: " " * len(found[0]), note.lower())
    if _WORDS["more"].search(text) or _WORDS["moot"].search(text):
        return None
    whole = [_Part("sensor", [*range(scenario.sensors)], *found.span()) for found in _WORDS["whole"].finditer(text)]
    always = [_Part("visit", [1], *found.span()) for found in _WORDS["always"].finditer(text)]
    try:
        numbers = _parts(text, scenario.step_s)
        orders = [*_limits(text, numbers)]
        past = [clause.span() for clause in _WORDS["clause"].finditer(text) if _WORDS["past"].search(clause[0])]
        if any(begin <= part.begin < end for begin, end in past for part in numbers if part.kind != "sensor"):
            return None
        parts = sorted(whole + always + [part for part in numbers if part.kind != "velocity"], key=lambda p: p.begin)
        orders += [*_ignored(text, parts)]
        orders += _wishes(text, parts)
    except ValueError:
        return None
    values = dict(orders)
    return values if values and values.items() >= {*orders} and "." not in "".join(values) else None


def confirms(note: str, orders: Mapping[str, float]) -> bool:
    """Whether each of the LLM's orders has a word of its kind in a sentence with its number, and none is in doubt."""
    text = _WORDS["aside"].sub("", note.lower())
    past = (clause[0] for clause in _WORDS["clause"].finditer(text) if _WORDS["past"].search(clause[0]))
    if _WORDS["moot"].search(text) or _CONFIRMS["against"].search(note.lower()) or any(map(numbers_of, past)):
        return False
    sentences = [part for part in re.split(r"(?<=[.;!?])\s+|\n+", note.lower()) if part.strip()]
    for name, value in orders.items():
        kind, _, sensor = name.partition(":")
        kind = "ignored" if kind == "weight" and not value else "still" if name == "avoid:0" else kind
        own = float(sensor) if kind in ("visit", "weight", "ignored") else value
        speeds = ((part, n.value * METRES_A_SECOND.get(n.unit, 1.0)) for part in sentences for n in numbers_of(part))
        near = [part for part, number in speeds if abs(number - own) < 1.0]
        if not any(_CONFIRMS[kind].search(part) for part in near or sentences):
            return False
    return True


def _parts(text: str, step_s: float) -> list[_Part]:
    """The parts of the numbers; raises ``ValueError`` where one is not known."""
    parts, numbers = list[_Part](), numbers_of(text)
    fast = _WORDS["velocity"].search(text) or any(number.unit in _SPEEDS for number in numbers)
    ends, begins = [0, *(n.end for n in numbers)], [*(n.begin for n in numbers), len(text)]
    for number, end, begin in zip(numbers, ends, begins[1:], strict=False):
        before, word, after = text[end : number.begin], text[number.begin : number.end], text[number.end : begin]
        value = number.value
        kinds = {kind for kind, (b, a) in _BESIDE.items() if b.search(text, 0, number.begin) or a.search(after)}
        if number.unit in _SPEEDS:
            kinds, value = {"velocity"}, value * _SPEEDS[number.unit]
        elif number.unit in SECONDS or number.unit == "steps":
            kinds = set() if _WORDS["lasting"].search(before) else {"visit"}
            value *= SECONDS.get(number.unit, step_s) / step_s
        elif number.unit:
            kinds = set()
        elif _WORDS["factor"].fullmatch(word):
            kinds = {"weight"}
        elif kinds <= {"sensor"} and (more := _listed(parts[-1:], value, before, after)):
            parts[-1].values += more
            parts[-1].end = number.end
            continue
        elif fast and (_WORDS["compared"].search(before) or (not kinds and _WORDS["range"].fullmatch(after))):
            kinds.add("velocity")
        elif not kinds and parts and parts[-1].kind == "velocity" and _WORDS["range"].fullmatch(before):
            kinds = {"velocity"}
        elif not kinds and word == "one":
            continue
        sentence = max((found.end() for found in _WORDS["stop"].finditer(text, 0, number.begin)), default=0)
        if kinds == {"weight"} and not _WORDS["valued"].search(text, sentence, begin):
            kinds = set()
        (kind,) = kinds
        parts.append(_Part(kind, [value], number.begin, number.end))
    return parts


def _listed(parts: list[_Part], value: float, before: str, after: str) -> list[float]:
    """The sensors that a number adds to a list just before it, as its next or as the end of a range, if any."""
    if not parts or parts[-1].kind != "sensor" or _WORDS["given"].match(after):
        return []
    if _WORDS["spans"].fullmatch(before):
        first = int(parts[-1].values[-1]) + 1
        return [*range(first, min(int(value), first + MAX_SENSORS) + 1)]
    return [value] if _WORDS["joins"].fullmatch(before) else []


def _limits(text: str, parts: list[_Part]) -> _Orders:
    """The orders of velocities, by the words around each list of them; raises ``ValueError`` if these are not plain."""
    lists: list[list[_Part]] = []
    for part in parts:
        if part.kind == "velocity" and lists and _WORDS["range"].fullmatch(text, lists[-1][-1].end, part.begin):
            lists[-1].append(part)
        elif part.kind == "velocity":
            lists.append([part])
    for listed in lists:
        limits = _around(text, listed[0].begin, listed[-1].end, parts)
        if limits == ["avoided"]:
            limits *= len(listed)
        elif len(listed) == 2 and "avoided" not in limits:
            spans = _WORDS["to"].fullmatch(text, listed[0].end, listed[1].begin)
            if spans or _WORDS["between"].search(text, 0, listed[0].begin) or len(limits) == 2:
                limits = ["least", "most"] if listed[0].values < listed[1].values else ["most", "least"]
        for limit, part in zip(limits, listed, strict=True):
            whole = int(part.values[0] + ROUNDING)
            if abs(part.values[0] - whole) > ROUNDING:
                raise ValueError("no whole velocity")
            yield _LIMITS[limit].format(whole), whole
    for clause in _WORDS["clause"].finditer(text):
        if _WORDS["still"].search(clause[0]) and not numbers_of(clause[0]):
            yield "avoid:0", 0


def _around(text: str, begin: int, end: int, parts: list[_Part]) -> list[str]:
    """The limits that the words around a place say: of its clause, else of its sentence, between its neighbours."""
    stops = [found.end() for found in _WORDS["stop"].finditer(text)]
    clauses = [found.span() for found in _WORDS["clause"].finditer(text)]
    first = max([0, *(at for at in stops + [part.end for part in parts] if at <= begin)])
    last = min([len(text), *(at for at in stops + [part.begin for part in parts] if at >= end)])
    near = max([first, *(at for at, _ in clauses if at <= begin)]), min([last, *(at for _, at in clauses if at >= end)])
    alone = sum(part.kind == "velocity" for part in parts if not begin <= part.begin < end) == 0
    sentences = zip([0, *stops], [*stops, len(text)], strict=True)
    apart = [(a, b) for a, b in sentences if alone and not any(a <= part.begin < b for part in parts)]
    for place in (near, (first, near[1]), (first, last), *apart):
        if found := [limit for limit in _LIMITS if _WORDS[limit].search(text, *place)]:
            if found == ["avoided"] and _WORDS["relative"].search(text, *place):
                raise ValueError("a limit, or a velocity that nobody flies")
            return found
    return []


def _ignored(text: str, parts: list[_Part]) -> _Orders:
    """The orders to ignore sensors, which leave the parts; raises ``ValueError`` where it is not plain which."""
    ignored: list[_Part] = []
    for clause in _WORDS["clause"].finditer(text):
        if not _WORDS["ignores"].search(clause[0]) or _WORDS["spares"].search(clause[0]):
            continue
        own = [part for part in parts if clause.start() <= part.begin < clause.end()]
        own = own or [part for part in parts if part.begin < clause.start()][-1:]
        if not own or any(part.kind != "sensor" for part in own):
            raise ValueError("nothing to ignore")
        ignored += own
    parts[:] = [part for part in parts if part not in ignored]
    yield from ((f"weight:{sensor:g}", 0.0) for part in ignored for sensor in part.values)


def _wishes(text: str, parts: list[_Part]) -> _Orders:
    """The orders of sensors, with the numbers beside or after them; raises ``ValueError`` where one is left alone."""
    ordered: list[_Part] = []
    for clause in _WORDS["clause"].finditer(text):
        own = [part for part in parts if clause.start() <= part.begin < clause.end()]
        # A number of the clause is before or after its sensors.
        ordered += own if own and own[0].kind == "sensor" else own[::-1]
    sensors: list[float] = []
    waiting = False
    ordered = ordered if ordered and ordered[0].kind == "sensor" else parts[::-1]
    for part in [*ordered, _Part("sensor", [], len(text), len(text))]:
        if part.kind == "sensor" and waiting:
            raise ValueError("a sensor without an order")
        if part.kind == "sensor":
            sensors, waiting = part.values, True
            continue
        value = int(part.values[0]) if part.kind == "visit" else part.values[0]
        if not sensors or value < (part.kind == "visit"):
            raise ValueError("no sensor, or a period below a step")
        waiting = False
        yield from ((f"{part.kind}:{sensor:g}", value) for sensor in sensors)
