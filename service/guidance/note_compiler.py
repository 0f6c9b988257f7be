"""Compiling an operator's note: an LLM rewrites it once as orders of a fixed form, and every order is checked here.

Where the server can constrain its answer, it is constrained to the orders that the note's numbers allow; it is parsed
strictly in any case. An answer that does not match the note, or that the fleet cannot follow, is refused, and the LLM
is asked again. An embedded LLM with the orders' adapter reads the note up to three times, each time with other letters
for its numbers, so that an answer caused by a letter does not recur; another LLM gets worked examples that resemble it.

No decision waits for a note: the embedded model answers one request at a time and serves decisions first.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from typing import Protocol

from service.guidance.lettered_orders import PARTLY, STATIC, NoteReading, grammar, meaning
from service.guidance.note_numbers import LetteredNote, numbers_of
from service.guidance.note_orders import INSTRUCTION, BadOrders, constrain_orders, parse_orders, similar_examples
from service.guidance.note_phrases import PhrasedNote
from service.guidance.operator_guidance import OperatorGuidance
from service.guidance.plain_reading import confirms, plain_reading
from service.llm.answers import NoDecision
from service.llm.request_bodies import Rewriting
from service.llm.server_pool import ServerPool
from shared.planning.orders import NO_GUIDANCE, Guidance, Impossible
from shared.world.scenario import Scenario

log = logging.getLogger(__name__)

# The first answer is the likeliest one; the later ones are sampled.
_ATTEMPTS = 5
_TEMPERATURE = 0.7
# For one answer, including the wait while decisions use the LLM, and for the whole note, including the LLM's loading.
ANSWER_S = 60.0
TIMEOUT_S = 300.0
_POLL_S = 0.2
_NOT_JUDGED = "How well this LLM reads notes is not known: compare each order with the note."

_READINGS = 3
_MOST_TOKENS = 96
_DIFFER = "“{note}” can be read in more than one way."
_ALONE = "No rule confirms the LLM's reading of “{note}”: compare the orders with it."


async def read_note(note: str, scenario: Scenario, llm: ServerPool) -> NoteReading:
    """The note's reading: certain if the rules read the same, or if three agree and words confirm each order.

    Raises:
        BadOrders: no rule reads the note, and most answers are no orders or find it unclear.
        Impossible: likewise, and most answers order something that the fleet cannot do.
        NoDecision: the LLM gave no answer.
    """
    plain = plain_reading(note, scenario)
    found: list[NoteReading | BadOrders | Impossible] = []
    for seed in range(_READINGS):
        try:
            lettered = LetteredNote.of(note, seed)
        except ValueError as error:
            raise BadOrders(str(error)) from None
        answer = await llm.rewrite(_request(lettered), temperature=0.0, seed=seed)
        reading = _checked(answer.text, lettered, scenario)
        if isinstance(reading, NoteReading) and not reading.guidance.ends and reading.guidance.values == plain:
            return reading
        found.append(reading)
    if plain is not None:
        with suppress(Impossible):
            guidance = Guidance.of(plain, {})
            guidance.check(scenario)
            used = frozenset(number.value for number in numbers_of(note.lower()))
            return NoteReading(guidance, (_DIFFER.format(note=note),), used)
    return _most(found, note)


def _request(note: LetteredNote) -> Rewriting:
    return Rewriting(STATIC, [], note.text, lambda _: {"grammar": grammar(note), "max_tokens": _MOST_TOKENS})


def _checked(answer: str, note: LetteredNote, scenario: Scenario) -> NoteReading | BadOrders | Impossible:
    try:
        reading = meaning(answer, note, scenario)
        reading.guidance.check(scenario)
    except (BadOrders, Impossible) as error:
        return error
    return reading


def _most(found: Sequence[NoteReading | BadOrders | Impossible], note: str) -> NoteReading:
    """The most frequent reading, the first of equal ones, with a doubt unless all agree and words confirm it.

    Raises the most frequent error.
    """
    texts = [str(one) if isinstance(one, Exception) else one.guidance.model_dump_json() for one in found]
    reading = found[texts.index(Counter(texts).most_common(1)[0][0])]
    if isinstance(reading, Exception):
        raise reading
    alone = reading.guidance and not confirms(note, reading.guidance.values)
    doubt = [_DIFFER.format(note=note)] if len(set(texts)) > 1 else [_ALONE.format(note=note)] * bool(alone)
    return NoteReading(reading.guidance, (*reading.doubts, *doubt), reading.numbers)


class NoteOwner(Protocol):
    """The part of a mission that compiling its note needs."""

    mission_id: str
    scenario: Scenario
    guidance: OperatorGuidance

    def in_ids(self, note: str) -> tuple[str, list[str]]:
        """The note with sensors' IDs for the user's names, and doubts."""

    def propose_guidance(
        self, guidance: Guidance, model: str | None, doubts: Sequence[str] = (), withdrawn: Sequence[str] = ()
    ) -> None:
        """Propose the guidance that was read in the note."""

    def fail_guidance(self, reason: str, model: str | None) -> None:
        """Record that the note was not compiled."""


class NoteCompiler:
    """Compiles the notes of a service's missions; of those that need the LLM one at a time.

    Args:
        on_change: called with the mission's ID when its note was compiled, or could not be.
    """

    def __init__(self, llm: ServerPool, on_change: Callable[[str], None] = lambda mission_id: None) -> None:
        self._llm = llm
        self._on_change = on_change
        self._lock = asyncio.Lock()
        self._tasks: dict[int, asyncio.Task[None]] = {}

    def compile(self, mission: NoteOwner) -> None:
        """Begin to compile the mission's note, unless it has none or its note is compiled or being compiled."""
        key = id(mission.guidance)
        if mission.guidance.status != "compiling" or ((running := self._tasks.get(key)) and not running.done()):
            return
        task = asyncio.create_task(self._compile(mission), name="compile-note")
        self._tasks[key] = task
        task.add_done_callback(lambda done: self._tasks.pop(key) if self._tasks.get(key) is done else None)

    async def close(self) -> None:
        """Cancel compiling."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _compile(self, mission: NoteOwner) -> None:
        # The operator may give another note meanwhile.
        while mission.guidance.status == "compiling" and (note := mission.guidance.note) is not None:
            await self._compile_once(mission, note)

    async def _compile_once(self, mission: NoteOwner, note: str) -> None:
        """Compile this note; the result is dropped if the mission has another note by then."""
        unclear: list[str] = []
        try:
            text, unclear = await asyncio.to_thread(mission.in_ids, note)
            # Compiling the phrases for a first note takes some 40 ms.
            phrased = await asyncio.to_thread(PhrasedNote, text, mission.scenario, mission.guidance.confirmed.values)
            unclear += phrased.unsaid
            async with asyncio.timeout(TIMEOUT_S):
                if not phrased.is_read:
                    await self._wait_for_llm(mission, note)
                async with nullcontext() if phrased.is_read else self._lock:
                    if not _waits_for(mission, note):
                        return
                    compiled = await compile_note(phrased, mission.scenario, self._llm)
            if _waits_for(mission, note):
                model = None if phrased.is_read else self._llm.notes_model
                mission.propose_guidance(compiled.guidance, model, (*unclear, *compiled.doubts), phrased.withdrawn)
                self._on_change(mission.mission_id)
            return
        except (BadOrders, Impossible, NoDecision) as error:
            reason = str(error)
        except TimeoutError:
            reason = "the LLM did not answer in time"
        except Exception as error:
            log.exception("mission %s: the note was not compiled", mission.mission_id)
            reason = f"{type(error).__name__}: see the log"
        if _waits_for(mission, note):
            mission.fail_guidance(" ".join((*unclear, f"{reason}; give `guidance` of your own")), self._llm.notes_model)
            self._on_change(mission.mission_id)

    async def _wait_for_llm(self, mission: NoteOwner, note: str) -> None:
        """Wait while the note does and the LLM loads or recovers; raises ``NoDecision`` if it is not ready then."""
        while self._llm.status != "ready" and self._llm.recovering and _waits_for(mission, note):
            await asyncio.sleep(_POLL_S)
        if self._llm.status != "ready":
            raise NoDecision("llm_unavailable", f"the LLM is {self._llm.status}")


def _waits_for(mission: NoteOwner, note: str) -> bool:
    """Whether this note is still to be compiled."""
    return mission.guidance.status == "compiling" and mission.guidance.note == note


async def compile_note(note: PhrasedNote, scenario: Scenario, llm: ServerPool) -> NoteReading:
    """The note's reading: by phrases, and of the rest with the orders' adapter, or else the first answer that passes.

    Raises:
        BadOrders: no answer passes, and the first one does not match the note; or the note contains no order.
        Impossible: no answer passes, and the first one orders something that the fleet cannot do.
        NoDecision: the LLM gave no answer.
    """
    started = time.monotonic()
    try:
        if note.is_foreign and not note.is_read:
            raise BadOrders("notes are read in English only")
        if note.is_read:
            reading = NoteReading(NO_GUIDANCE)
        elif llm.reads_letters:
            async with asyncio.timeout(ANSWER_S):
                reading = await read_note(note.text, scenario, llm)
        else:
            reading = await _rewrite_note(note.text, scenario, llm)
    except (BadOrders, Impossible) as error:
        if not note.orders:
            raise
        # What code has read is proposed all the same.
        reading = NoteReading(NO_GUIDANCE, (f"In no order: “{note.text}”: {error}.",))
    guidance, doubts = note.completed(reading.guidance, reading.numbers)
    guidance.check(scenario)
    log.info("note compiled in %.1f s", time.monotonic() - started)
    if PARTLY in reading.doubts and not doubts:
        doubts = [f"{PARTLY}: “{note.text}”."]
    return NoteReading(guidance, (*(doubt for doubt in reading.doubts if doubt != PARTLY), *doubts))


async def _rewrite_note(note: str, scenario: Scenario, llm: ServerPool) -> NoteReading:
    rewriting = Rewriting(
        INSTRUCTION, similar_examples(note), note, lambda constraint: constrain_orders(constraint, note)
    )
    faults: list[BadOrders | Impossible] = []
    for attempt in range(_ATTEMPTS):
        temperature = _TEMPERATURE if attempt else 0.0
        async with asyncio.timeout(ANSWER_S):
            text = (await llm.rewrite(rewriting, temperature=temperature, seed=attempt)).text
        try:
            guidance = parse_orders(text, note)
            guidance.check(scenario)
        except (BadOrders, Impossible) as error:
            log.debug("note, attempt %d: %r: %s", attempt, text[:80], error)
            faults.append(error)
            continue
        numbers = {*guidance.values.values(), *(float(name.split(":")[1]) for name in guidance.values if ":" in name)}
        return NoteReading(guidance, (_NOT_JUDGED,), frozenset(numbers))
    raise faults[0]
