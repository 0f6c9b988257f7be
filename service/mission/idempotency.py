"""Requests sent again under the same key: the same answer, however often they come, and after a restart too."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from service.errors import Refused, Unavailable
from shared.bounded import BoundedDict

# Quotes within a text are escaped, so no text has this.
_A_DECISION = '"decision_id":'


@dataclass(frozen=True, slots=True)
class Answered:
    """The answer to a request under a key; ``digest`` says which request that was."""

    key: str
    digest: str
    body: str

    @property
    def decisions(self) -> int:
        """How many decisions it tells, at least one: those of a batch are one answer."""
        return max(1, self.body.count(_A_DECISION))


class IdempotentAnswers:
    """The newest answers by key, as JSON.

    Args:
        most: how many decisions are remembered; of a single answer with more, all.
    """

    def __init__(self, most: int) -> None:
        self._answers = BoundedDict[str, Answered](most, lambda answered: answered.decisions)
        self._underway: dict[str, tuple[str, asyncio.Future[str]]] = {}

    async def once(
        self, key: str, request: str, make: Callable[[], Awaitable[str]], record: Callable[[Answered], None]
    ) -> str:
        """The answer under this key; made where there is none yet, else waited for or remembered.

        Args:
            request: its canonical text; under one key there is one.
            record: hears of an answer that was made.

        Raises:
            Refused: the key was used for another request.
        """
        digest = hashlib.sha256(request.encode()).hexdigest()
        underway = self._underway.get(key)
        known = self._answers.get(key)
        if (underway and underway[0] != digest) or (known and known.digest != digest):
            raise Refused("Idempotency-Key", "this key was used for another request of this mission")
        if known is not None:
            return known.body
        if underway is not None:
            return await asyncio.shield(underway[1])
        waiting: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._underway[key] = digest, waiting
        try:
            body = await make()
        except BaseException as error:
            # Whoever waits fails alike; nobody may be waiting.
            gone = Unavailable("Idempotency-Key", "the request under this key was given up: send it again")
            waiting.set_exception(error if isinstance(error, Exception) else gone)
            waiting.exception()
            raise
        finally:
            del self._underway[key]
        answered = Answered(key, digest, body)
        self.remember(answered)
        record(answered)
        waiting.set_result(body)
        return body

    def knows(self, key: str) -> bool:
        """Whether there is an answer under this key, or one is being made."""
        return key in self._answers or key in self._underway

    def remember(self, answered: Answered) -> None:
        """Keep an answer; the oldest of too many is forgotten."""
        self._answers[answered.key] = answered

    def state_dict(self) -> list[Any]:
        """The answers, oldest first."""
        return [[a.key, a.digest, a.body] for a in self._answers.values()]

    def load_state_dict(self, state: list[Any]) -> None:
        """As they were when the state was taken."""
        self._answers.clear()
        for told in state:
            self.remember(Answered(*told))
