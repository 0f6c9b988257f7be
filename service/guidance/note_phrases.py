"""The parts of an operator's note that code reads: withdrawals, single visits, ends of orders, and what is in no order.

The orders' adapter knows no withdrawals, and few ends. ``note_phrases.toml`` has the phrases; the LLM reads the rest.
"""

import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from fnmatch import filter as matching
from functools import cache, partial
from importlib.resources import files
from typing import Any

from service.guidance.lettered_orders import METRES_A_SECOND, SECONDS, SEPARATOR, meaning
from service.guidance.note_numbers import CARDINALS, ORDINALS, LetteredNote, Number, numbers_of
from service.guidance.note_orders import BadOrders
from shared.planning.orders import NO_GUIDANCE, End, Guidance
from shared.world.scenario import Scenario

_TABLE = tomllib.loads(files("service.guidance").joinpath("note_phrases.toml").read_text(encoding="utf-8"))
_STOP = re.compile(r"[.;!?](?=\s|$)")
_CLAUSE = r"(?:[^.,;:!?]|[.,:](?=\S))+?(?=[.,;:!?](?:\s|$)| and | but | - |\n|$)"


@cache
def _pattern(phrase: str) -> re.Pattern[str]:
    """The phrase's regular expression. To compile all takes 60 ms, which a start without notes does not need."""
    while (filled := re.sub(r"\{([a-zA-Z]+)\}", lambda part: _PARTS[part[1]], phrase)) != phrase:
        phrase = filled
    return re.compile(phrase)


_PARTS: dict[str, str] = {**_TABLE["parts"], "words": "|".join([*CARDINALS[::-1], *ORDINALS])}
_Matches = Iterator[re.Match[str]]


class PhrasedNote:
    """A note without the phrases that code reads.

    Attributes:
        rest: the note in lower case, with spaces in place of these phrases.
        withdrawn: patterns of the names of orders in force that end.
        is_foreign: whether it has words of another language than English.

    Args:
        in_force: the names of the orders in force.
    """

    def __init__(self, note: str, scenario: Scenario, in_force: Collection[str]) -> None:
        for other, words in _TABLE["normal"].items():
            note = re.sub(other, words, note, flags=re.IGNORECASE)
        self._note = note
        self.rest = self._lowered = note.lower()
        self._scenario, self._in_force = scenario, in_force
        self.withdrawn: list[str] = []
        self.is_foreign = len(re.findall(_TABLE["foreign"]["words"], self._lowered)) > 1
        self._doubts: list[str] = []
        self._quoted: list[str] = []
        self._once: dict[str, float] = {}
        self._ends: list[tuple[re.Match[str], str, End | None]] = []
        self._orders: list[tuple[str, re.Match[str]]] = []
        for match in self._taken(_TABLE["quoted"]["phrases"]):
            self._quoted.append(re.sub(r",? (?:and|but)$", "", match[0].strip()))
        for row in _TABLE["withdraw"]:
            for match in self._taken(row["phrases"], partial(self._withdraws, row, in_force)):
                self.withdrawn += _names(row, match)
        for match in self._taken(_TABLE["once"]["phrases"]):
            self._once |= {f"visit:{sensor}": 1 for sensor in _sensors(match["S"])}
        for kind, phrases in _TABLE["ends"].items():
            self._ends += [(match, kind, self._end(kind, match)) for match in self._taken(phrases)]
        for match in self._taken(_TABLE["times"]["phrases"]):
            self._doubts.append(f"In no order: “{match[0].strip()}”.")
        list(self._taken(_TABLE["added"]["phrases"]))
        for row in _TABLE["order"]:
            plain = self._taken(row["phrases"], lambda match: not self._says("conditional", match))
            self._orders += [(row["means"], match) for match in plain]
        list(self._taken([_CLAUSE], self._is_chat))

    @property
    def orders(self) -> bool:
        """Whether code has read an order or a withdrawal."""
        return bool(self.withdrawn or self._once or self._orders)

    @property
    def unsaid(self) -> list[str]:
        """What no order can say, with the reason."""
        found = [(why, _pattern(phrase).search(self._lowered)) for why, phrase in _TABLE["unsaid"].items()]
        return [why.format(match[0].strip()) for why, match in found if match]

    @property
    def text(self) -> str:
        """The rest as the LLM reads it; the note as it is written if code has read nothing."""
        if self.rest == self._lowered:
            return self._note
        rest = re.sub(r"[\s,;:]*\s(?=[.,;:!?]|$)|^(?:\W|and |then )+", "", " ".join(self.rest.split()))
        return re.sub(r"(?<=[.!?])[,;:.]+", "", rest)

    @property
    def is_read(self) -> bool:
        """Whether the rest has nothing for the LLM to read."""
        if numbers_of(self.rest) or any(self._unread(self._read_orders().values, ())):
            return False
        return self.orders or not self.rest.strip(" .,;:!?")

    def completed(self, read: Guidance, numbers: Collection[float]) -> tuple[Guidance, list[str]]:
        """The whole note's guidance, and doubts: what is in no order, and ends that no order can have.

        Args:
            read: the LLM's reading of the rest.
            numbers: the numbers of the rest that its orders use.
        """
        own = self._read_orders()
        refused = self._refused({name: value for name, value in read.values.items() if name not in own.values})
        values = {**{n: v for n, v in read.values.items() if n not in refused}, **own.values, **self._once}
        if refused and not values and not self.withdrawn:
            raise BadOrders(f"unclear: “{next(iter(refused.values()))}” may end an order or mean a part of the fleet")
        if not values and not self.withdrawn and _has("vague", self.rest):
            raise BadOrders("the note is unclear: say how fast")
        if self._quoted and not values and not self.withdrawn:
            raise BadOrders(f"“{self._quoted[0]}” asks or has a condition, which is no order")
        ends = {name: end for name, end in read.ends.items() if name in values}
        if not _has("always", self._lowered):
            ends |= {n: End(visited=int(n[6:])) for n, v in read.values.items() if n[:5] == "visit" and v == 1}
        ends |= {name: End(visited=int(name[6:])) for name in self._once}
        doubts = self._doubts + [f"In no order: “{w}”." for w in (*self._quoted, *filter(None, refused.values()))]
        for match, kind, end in self._ends:
            names = [n for n in values if n not in self._once and self._in_sentence(n, values, match.start())]
            for name in names if end is not None or kind == "visited" else ():
                sensor = self._visited(match, name, values)
                if (its := end if sensor is None else End(visited=sensor)) is not None:
                    ends[name] = its
            if kind != "open" and not any(name in ends for name in names):
                doubts.append(f"No order ends by itself “{match[0].strip()}”: withdraw it then.")
        sensors = (float(name[6:]) for name in own.values if name.startswith("visit:"))
        doubts += [
            f"In no order: “{clause}”." for clause in self._unread(values, {*(numbers if values else ()), *sensors})
        ]
        return Guidance.of(values, ends), list(dict.fromkeys(doubts))

    def _refused(self, values: Mapping[str, float]) -> dict[str, str]:
        """The LLM's orders that its words may end or permit, or that no word gives to every sensor, with the words."""
        refused = {}
        text = re.sub(r"(?<=\d)(?:,| and|, and) (?=\d)", " ", self.rest)
        clauses = [" ".join(clause[0].split()) for clause in re.finditer(_CLAUSE, text)]
        numbers = numbers_of(text)
        measures = [n for n in numbers if n.unit or not re.search(_TABLE["whose"]["words"], text[: n.begin])]
        step_s = self._scenario.step_s
        periods = {1, *(_steps(n, step_s) for n in measures)}
        whole = any(_has("whole", clause) and not _has("place", clause) for clause in clauses)
        for name, value in values.items():
            kind, _, sensor = name.partition(":")
            ignored = kind == "weight" and not value
            near = [c for c in clauses if _uses(name, value, numbers_of(c))]
            if ignored:
                near += [c for c in clauses if _has("ignores", c) and _has("there", c)]
            if kind == "visit":
                near += [c for c in clauses if any(n.unit and _steps(n, step_s) == value for n in numbers_of(c))]
            near = near or [c for c in clauses if re.search(_TABLE["asks"][kind], c)]
            against = _TABLE["against"]["ignore" if ignored else kind]
            both = f"visit:{sensor}" in values and values.get(f"weight:{sensor}") == 0
            measured = value in periods if kind == "visit" else "_" not in kind or _uses(name, value, measures)
            if kind == "weight" and value and not whole and not re.search("doubl|twice|tripl", text):
                spoken = [n.value for n in numbers if _has("named", text[: n.begin])].count(value)
                own = f"visit:{value:g}" in values or value == int(sensor)
                measured = [n.value for n in numbers].count(value) > max(spoken, own)
            denied = near and all(any(_has(k, c) for k in against) for c in near)
            denied = denied or (ignored and any(_has("said", c) or (not near and _has("single", c)) for c in clauses))
            if both or denied or not measured or (kind == "avoid" and not near):
                refused[name] = next(iter(near), " ".join(self.rest.split()))
            elif ignored and near and (all(_has("lifts", c) for c in near) or not _has("ignores", self._lowered)):
                # "No need to visit it" ends the visits, and says nothing of what the sensor loses.
                if f"visit:{sensor}" in self._in_force:
                    refused[name] = ""
                    self.withdrawn.append(f"visit:{sensor}")
                elif any(_has("ended", c) for c in near) or any(
                    _has("served", c) and _has("there", c) for c in clauses
                ):
                    refused[name] = near[0]
        for kind in () if whole else ("visit", "weight"):
            named = [name for name in values if name.startswith(kind)]
            rest = kind == "weight" and re.search(r"\b(?:rest|others?|elsewhere)\b", text)
            if not rest and len(named) == self._scenario.sensors > len(numbers):
                refused |= dict.fromkeys(named, " ".join(self.rest.split()))
        return refused

    def _taken(self, phrases: Iterable[str], wanted: Callable[[re.Match[str]], bool] = bool) -> _Matches:
        for phrase in phrases:
            for match in filter(wanted, _pattern(phrase).finditer(self.rest)):
                self.rest = self.rest[: match.start()] + " " * len(match[0]) + self.rest[match.end() :]
                yield match

    def _is_chat(self, clause: re.Match[str]) -> bool:
        """Whether a clause only counts what no order is about: it has no word of one, nor a sensor's or a velocity."""
        most, numbers = max(self._scenario.sensors - 1, self._scenario.max_velocity), numbers_of(clause[0])
        others = (
            n.value > most and n.unit in (None, "m", "km") and _has("counted", clause[0][n.begin :]) for n in numbers
        )
        return bool(numbers) and not _has("orderly", clause[0]) and all(others)

    def _says(self, kind: str, match: re.Match[str]) -> bool:
        """Whether the sentence of a phrase has words of a kind."""
        begin = _STOP.split(self._lowered[: match.start()])[-1]
        return _has(kind, begin + re.split(r"(?<=[.;!?])(?=\s|$)", self._lowered[match.start() :])[0])

    def _withdraws(self, row: Mapping[str, Any], in_force: Collection[str], match: re.Match[str]) -> bool:
        known = not row.get("in_force") or any(matching(in_force, name) for name in _names(row, match))
        return known and not self._says("conditional", match) and not self._says("limited", match)

    def _read_orders(self) -> Guidance:
        """The guidance of the plain orders; raises as :func:`meaning`."""
        if not self._orders:
            return NO_GUIDANCE
        note = LetteredNote.of(self._lowered, 0)

        def letters(match: re.Match[str], part: str) -> str:
            # Each of a list's pieces is one number or a range.
            begin, pieces = match.start(part), re.finditer(r"(?:(?! ?[,&]| and | or ).)+", match[part])
            at = {number.begin - begin: letter for letter, number in note.numbers.items()}
            spans = ([at[b] for b in sorted(at) if piece.start() <= b < piece.end()] for piece in pieces)
            return " ".join("-".join(span) for span in spans if span)

        answer = []
        for means, match in self._orders:
            parts = {part: letters(match, part) for part in match.re.groupindex if f"{{{part}}}" in means}
            answer.append(means.format_map(parts))
        return meaning(SEPARATOR.join(answer), note, self._scenario).guidance

    def _end(self, kind: str, match: re.Match[str]) -> End | None:
        if kind == "time":
            return _clock(match)
        if kind not in ("step", "through", "steps"):
            return None
        number = numbers_of(match["N"])[0]
        seconds = SECONDS.get(number.unit or "", self._scenario.step_s) * number.value
        try:
            if kind == "steps":
                return End(steps=max(1, round(seconds / self._scenario.step_s)))
            return End(step=int(number.value) + (kind == "through"))
        except ValueError:
            return None

    def _visited(self, match: re.Match[str], name: str, values: Mapping[str, float]) -> int | None:
        """The sensor whose visit ends this order, where a visit does."""
        if "S" not in match.re.groupindex:
            return None
        if match["S"]:
            return _sensors(match["S"])[0]
        sensors = {int(own.partition(":")[2]) for own in values if own.startswith("visit:")}
        kind, _, number = name.partition(":")
        return int(number) if kind == "visit" else sensors.pop() if len(sensors) == 1 else None

    def _in_sentence(self, name: str, values: Mapping[str, float], at: int) -> bool:
        """Whether an order's numbers are not only elsewhere than where an end at this place belongs.

        An end belongs to its sentence; to the words before it if no comma comes between them.
        """
        stops = [0, *(stop.end() for stop in _STOP.finditer(self._lowered)), len(self._lowered)]
        sentence = (max(stop for stop in stops if stop <= at), min(stop for stop in stops if stop > at))
        (apart,) = map(_pattern, _TABLE["apart"]["phrases"])
        begin = max((found.end() for found in apart.finditer(self._lowered, sentence[0], at)), default=sentence[0])
        ends = [match.span() for match, _, _ in self._ends]
        numbers = [n for n in numbers_of(self._lowered) if not any(begin <= n.begin < end for begin, end in ends)]
        before, around = ([n for n in numbers if b <= n.begin < e] for b, e in ((begin, at), sentence))
        before = before if any(_uses(other, values[other], before) for other in values) else around
        return _uses(name, values[name], before) or not _uses(name, values[name], numbers)

    def _unread(self, values: Mapping[str, float], used: Collection[float]) -> Iterator[str]:
        for clause in re.finditer(_CLAUSE, self.rest):
            numbers = [n for n in numbers_of(clause[0]) if clause[0][n.begin : n.end] not in ("one", "first", "second")]
            met = ("avoid",) if "min_velocity" in values else ()
            asked = [kind for kind, words in _TABLE["asks"].items() if kind not in met and re.search(words, clause[0])]
            lost = numbers and not all(number.value in used for number in numbers)
            part = asked or _has("whole", clause[0]) or any(n.unit and n.unit in METRES_A_SECOND for n in numbers)
            ignored = "none" in asked or (
                not numbers and any(not any(name.startswith(kind) for name in values) for kind in asked)
            )
            if lost or ignored or (part and _has("place", clause[0])):
                yield " ".join(re.sub(r"^\W*(?:and|but|then)\b", "", clause[0]).split())


def _has(kind: str, text: str) -> bool:
    return any(_pattern(phrase).search(text) for phrase in _TABLE[kind]["phrases"])


def _uses(name: str, value: float, numbers: list[Number]) -> bool:
    kind, _, number = name.partition(":")
    if kind in ("visit", "weight"):
        return any(one.unit is None and one.value == int(number) for one in numbers)
    speeds = [one.value * METRES_A_SECOND[one.unit] for one in numbers if one.unit in METRES_A_SECOND]
    return any(abs(speed - value) < 1 for speed in speeds)


def _steps(number: Number, step_s: float) -> int:
    return int(number.value * SECONDS.get(number.unit or "", step_s) / step_s)


def _names(row: Mapping[str, Any], match: re.Match[str]) -> list[str]:
    sensors = _sensors(match["S"]) if "S" in match.re.groupindex else [0]
    return [name.format(sensor) for name in row["names"] for sensor in sensors]


def _sensors(text: str) -> list[int]:
    """The sensors of a list such as ``3, 5 and 7-9``."""
    sensors: list[int] = []
    end = 0
    for number in numbers_of(text):
        first = (
            sensors[-1] + 1 if sensors and re.search(r"-|to|through", text[end : number.begin]) else int(number.value)
        )
        sensors += range(first, min(int(number.value), first + 1_999) + 1)
        end = number.end
    return sensors


def _clock(match: re.Match[str]) -> End | None:
    """The next time of this kind, in the edge's time zone."""
    hour, half = int(match["hour"]), match["half"] or match["half2"] or ""
    hour = hour % 12 + 12 * half.startswith("p") if half[:1] in ("a", "p") else hour
    if hour > 24 or int(match["minute"] or 0) > 59:
        return None
    # Without a zone, for tomorrow's may be another one.
    now = datetime.now()
    time = now.replace(hour=hour % 24, minute=int(match["minute"] or 0), second=0, microsecond=0)
    return End(time=(time if time > now else time + timedelta(days=1)).astimezone())
