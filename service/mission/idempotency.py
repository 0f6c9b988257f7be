"""Idempotency keys: a request repeated under its key gets the same answer, even after a restart."""

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any
from zlib import compressobj, decompress

from service.errors import Refused, Unavailable
from shared.kit.bounded import BoundedDict
from shared.wire.schemas import BatchRequest, DecideRequest
from shared.wire.sensor_arrays import arrays_of

AnyRequest = DecideRequest | BatchRequest
# JSON escapes quotes within a text, so only the field's name matches.
_DECISION_FIELD = '"decision_id":'
# Raw deflate with a window of 4 kB.
_WINDOW = -12


@dataclass(frozen=True, slots=True)
class Answered:
    """The answer to a request under an idempotency key, with the request's :func:`digest_of`."""

    key: str
    digest: str
    body: str

    @property
    def decisions(self) -> int:
        """The number of decisions in the answer, at least 1; a batch has one answer for all."""
        return max(1, self.body.count(_DECISION_FIELD))


def digest_of(request: AnyRequest) -> str:
    """A request's SHA-256: of its sensors as arrays, which is faster than as JSON, where they have positions."""
    uavs = request.uavs if isinstance(request, BatchRequest) else [request]
    if not all(uav.sensors.x for uav in uavs):
        return _of_json(request)
    rows: Any = {"uavs": {"__all__": {"sensors"}}} if isinstance(request, BatchRequest) else {"sensors"}
    found = hashlib.sha256(request.model_dump_json(exclude=rows).encode())
    for own in (arrays_of(uav.sensors) for uav in uavs):
        for array in (own.ids, own.places, own.queue, own.battery, own.gain, own.beacon):
            found.update(len(array).to_bytes(4, "little") + array.tobytes())
    return found.hexdigest()


def _of_json(request: AnyRequest) -> str:
    return hashlib.sha256(request.model_dump_json().encode()).hexdigest()


class IdempotentAnswers:
    """The newest answers by key, as JSON.

    Args:
        most: the number of decisions that are remembered. A single answer with more is remembered whole.
    """

    def __init__(self, most: int) -> None:
        # By key: the digest of the request, the number of decisions, and the body in a quarter to half of its bytes.
        self._answers = BoundedDict[str, tuple[str, int, bytes]](most, itemgetter(1))
        self._in_progress: dict[str, tuple[str, asyncio.Future[str]]] = {}

    async def once(
        self, key: str, request: AnyRequest, make: Callable[[], Awaitable[str]], record: Callable[[Answered], None]
    ) -> str:
        """The answer under this key: remembered, in progress, or else made now.

        Args:
            record: receives an answer that is made now.

        Raises:
            Refused: the key belongs to another request.
        """
        digest = digest_of(request)
        in_progress = self._in_progress.get(key)
        known = self._answers.get(key)
        # Version 0.1.0 stored the digest of the JSON.
        if (used := in_progress or known) and used[0] not in (digest, _of_json(request)):
            raise Refused("Idempotency-Key", "this key was used for another request of this mission")
        if known is not None:
            return _text(known[2])
        if in_progress is not None:
            return await asyncio.shield(in_progress[1])
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._in_progress[key] = digest, answer
        try:
            body = await make()
        except BaseException as error:
            # Requests that wait for this answer fail too. There may be none, so the exception is marked as retrieved.
            cancelled = Unavailable("Idempotency-Key", "the request under this key was cancelled: send it again")
            answer.set_exception(error if isinstance(error, Exception) else cancelled)
            answer.exception()
            raise
        finally:
            del self._in_progress[key]
        answered = Answered(key, digest, body)
        self.remember(answered)
        record(answered)
        answer.set_result(body)
        return body

    def knows(self, key: str) -> bool:
        """Whether an answer under this key is remembered or in progress."""
        return key in self._answers or key in self._in_progress

    def remember(self, answered: Answered) -> None:
        """Remember an answer; past the limit the oldest is forgotten."""
        # Small tables: 7 us in place of the 60 us of `zlib.compress`.
        packer = compressobj(level=1, wbits=_WINDOW, memLevel=4)
        packed = packer.compress(answered.body.encode()) + packer.flush()
        self._answers[answered.key] = answered.digest, answered.decisions, packed

    def state_dict(self) -> list[Any]:
        """The answers, oldest first."""
        return [[key, digest, _text(body)] for key, (digest, _, body) in self._answers.items()]

    def load_state_dict(self, state: list[Any]) -> None:
        """Restore a ``state_dict``."""
        self._answers.clear()
        for answered in state:
            self.remember(Answered(*answered))


def _text(packed: bytes) -> str:
    return decompress(packed, _WINDOW).decode()
