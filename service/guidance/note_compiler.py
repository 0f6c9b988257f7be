"""Compiling an operator's note: an LLM rewrites it as orders of a fixed form, once, and every order is checked here.

The LLM is shown worked examples like the note as turns of a conversation, and held to the orders that the note's
numbers allow where the server can. Its answer is read strictly whatever the server promised; one that does not stand up
to the note, or that the fleet cannot obey, is refused and drawn again a few times. What a note means is the LLM's to
say: without one nothing is compiled.

It runs beside the decisions: none waits for it, and with the embedded model, which answers one question at a time, it
gives way to them.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import Protocol

from service.guidance.note_orders import INSTRUCTION, BadOrders, read, shown
from service.guidance.operator_guidance import OperatorGuidance
from service.guidance.order_grammar import constrain_orders
from service.llm.answer_format import NoDecision
from service.llm.request_bodies import Rewriting
from service.llm.server_pool import ServerPool
from shared.guidance import Guidance, Impossible
from shared.scenario import Scenario

log = logging.getLogger(__name__)

# The first is the likeliest answer, the rest are drawn.
_ATTEMPTS = 5
_TEMPERATURE = 0.7
# An answer and the wait for silence, and the whole of it, the LLM's loading included.
_ANSWER_S = 60.0
_TIMEOUT_S = 300.0
_POLL_S = 0.2


class NoteOwner(Protocol):
    """A mission, as far as its operator's note goes."""

    mission_id: str
    scenario: Scenario
    guidance: OperatorGuidance

    def propose_guidance(self, guidance: Guidance, model: str | None) -> None:
        """An LLM made this of the note."""
        ...

    def fail_guidance(self, reason: str, model: str | None) -> None:
        """Nothing could be made of the note."""
        ...


class NoteCompiler:
    """Compiles the notes of a service's missions, one after another."""

    def __init__(self, llm: ServerPool) -> None:
        self._llm = llm
        self._turn = asyncio.Lock()
        self._tasks: dict[int, asyncio.Task[None]] = {}

    def compile(self, mission: NoteOwner) -> None:
        """Begin, unless the mission has no note or its note is compiled or being compiled."""
        key = id(mission.guidance)
        if mission.guidance.status != "compiling" or key in self._tasks:
            return
        task = asyncio.create_task(self._compile(mission), name="compile-note")
        self._tasks[key] = task
        task.add_done_callback(lambda _: self._tasks.pop(key, None))

    async def close(self) -> None:
        """Give up compiling."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _compile(self, mission: NoteOwner) -> None:
        note = mission.guidance.note or ""
        try:
            async with asyncio.timeout(_TIMEOUT_S), self._turn:
                await self._ready()
                if mission.guidance.status != "compiling":
                    return
                mission.propose_guidance(await understood(note, mission.scenario, self._llm), self._llm.model)
                return
        except (BadOrders, Impossible, NoDecision) as error:
            why = str(error)
        except TimeoutError:
            why = f"no answer in {_TIMEOUT_S:g} s"
        except Exception as error:
            log.exception("mission %s: the note was not compiled", mission.mission_id)
            why = f"{type(error).__name__}: see the log"
        mission.fail_guidance(f"{why}; give `guidance` of your own", self._llm.model)

    async def _ready(self) -> None:
        """Wait while the LLM loads, or recovers."""
        while self._llm.status != "ready" and self._llm.recovering:
            await asyncio.sleep(_POLL_S)
        if self._llm.status != "ready":
            raise NoDecision("llm_unavailable", f"the LLM is {self._llm.status}")


async def understood(note: str, scenario: Scenario, llm: ServerPool) -> Guidance:
    """The first of a few answers that stands up to every check.

    Raises:
        BadOrders: none does, or the note has nothing to ask about; the first answer's fault.
        Impossible: the same, where the first one asks for what the fleet cannot do.
        NoDecision: the LLM gave no answer.
    """
    wanted = Rewriting(INSTRUCTION, shown(note), note, lambda constraint: constrain_orders(constraint, note))
    faults: list[BadOrders | Impossible] = []
    begun = time.monotonic()
    for attempt in range(_ATTEMPTS):
        temperature = _TEMPERATURE if attempt else 0.0
        async with asyncio.timeout(_ANSWER_S):
            text = await llm.rewrite(wanted, temperature=temperature, seed=attempt)
        try:
            guidance = read(text, note)
            guidance.check(scenario)
        except (BadOrders, Impossible) as error:
            log.debug("note, attempt %d: %r: %s", attempt, text[:80], error)
            faults.append(error)
            continue
        log.info("note compiled in %.1f s, attempt %d", time.monotonic() - begun, attempt)
        return guidance
    raise faults[0]
