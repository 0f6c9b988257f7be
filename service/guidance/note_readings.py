"""Reading a note with the orders' adapter: three times, each time with other letters for its numbers.

The letters are drawn anew for each reading, so that an answer caused by a letter does not recur. The most frequent
reading is the note's. It has doubts if another one differs or a token of an answer was unlikely.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from service.guidance.lettered_orders import STATIC, NoteReading, grammar, meaning
from service.guidance.note_numbers import LetteredNote
from service.guidance.note_orders import BadOrders
from service.llm.answers import Completion
from service.llm.request_bodies import Constraint, Rewriting
from service.llm.server_pool import ServerPool
from shared.planning.orders import Impossible
from shared.world.scenario import Scenario

_READINGS = 3
# An answer is certain if the joint probability of its tokens is at least this. Of 160 made-up notes of held-out
# phrasings the adapter that ships read 20 with this certainty, all correctly; at 0.98 it read 25, 2 of them wrongly, at
# 0.8 64 and 8.
_SURE = 0.99
_MOST_TOKENS = 96
_LIKELIEST = 5
_DIFFER = "The note can be read in more than one way."
_UNLIKELY = "The LLM is not sure of this reading."


async def read_note(note: str, scenario: Scenario, llm: ServerPool) -> NoteReading:
    """The note's reading.

    Raises:
        BadOrders: most answers are no orders, or the note is unclear.
        Impossible: most answers order something that the fleet cannot do.
        NoDecision: the LLM gave no answer.
    """
    found: list[tuple[NoteReading | BadOrders | Impossible, float]] = []
    for seed in range(_READINGS):
        try:
            lettered = LetteredNote.of(note, seed)
        except ValueError as error:
            raise BadOrders(str(error)) from None
        answer = await llm.rewrite(_request(lettered), temperature=0.0, seed=seed)
        found.append((_checked(answer.text, lettered, scenario), _probability(answer)))
    return _most(found)


def _request(note: LetteredNote) -> Rewriting:
    def constrain(_: Constraint) -> dict[str, object]:
        likeliest = {"logprobs": True, "top_logprobs": _LIKELIEST}
        return {"grammar": grammar(note), "max_tokens": _MOST_TOKENS, **likeliest}

    return Rewriting(STATIC, [], note.text, constrain)


def _checked(answer: str, note: LetteredNote, scenario: Scenario) -> NoteReading | BadOrders | Impossible:
    try:
        reading = meaning(answer, note, scenario)
        reading.guidance.check(scenario)
    except (BadOrders, Impossible) as error:
        return error
    return reading


def _probability(answer: Completion) -> float:
    """The joint probability of the answer's tokens; 0 if the server gives none."""
    if not answer.positions:
        return 0.0
    return math.prod(position.likeliest.get(position.token.strip(), 0.0) for position in answer.positions)


def _most(found: Sequence[tuple[NoteReading | BadOrders | Impossible, float]]) -> NoteReading:
    """The most frequent reading, the likelier of equal ones; raises the most frequent error."""
    texts = [str(one) if isinstance(one, Exception) else one.guidance.model_dump_json() for one, _ in found]
    often = Counter(texts)
    best = max(range(len(found)), key=lambda i: (often[texts[i]], found[i][1]))
    reading = found[best][0]
    if isinstance(reading, Exception):
        raise reading
    doubts = list(reading.doubts)
    if len(often) > 1:
        doubts.append(_DIFFER)
    elif min(probability for _, probability in found) < _SURE:
        doubts.append(_UNLIKELY)
    return NoteReading(reading.guidance, tuple(doubts))
