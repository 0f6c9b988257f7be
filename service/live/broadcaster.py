"""Who watches a mission, and what they are told: at most ten times a second, made once however many watch.

A listener asks for what is next when the network has taken what came before. So one that is slow, or stops reading,
holds no more than its place: what it misses is dropped, and it goes on from a snapshot. Nothing runs for a mission that
nobody watches.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager

from service.errors import Unavailable
from service.live import snapshots
from service.live.recent_decisions import RecentDecisions
from service.mission.mission import Mission
from service.prompting.prompt import Prompt
from shared.wire import DecideResponse, Outcome, UavState

log = logging.getLogger(__name__)

# At most so many at once over all missions.
MOST_LISTENERS = 32
_PERIOD_S = 0.1
# Of the event loop's time, the most that making updates may take: one of 10,000 sensors takes milliseconds.
_SHARE = 0.05
# Updates that are kept for a listener that is a little late.
_MOST_FRAMES, _MOST_BYTES = 30, 1_000_000
# Of a snapshot, decisions.
_SHOWN = 300
_HEARTBEAT_S = 5.0
# What a listener does not take in so long has stopped reading; at the end of the service it is given up sooner.
_STALLED_S, _LAST_S = 20.0, 0.5


class MissionStream:
    """One mission while somebody watches it."""

    def __init__(self, mission: Mission, history: RecentDecisions) -> None:
        self.mission = mission
        self.listeners = 0
        self.gone = False
        self._history = history
        self._frames: deque[bytes] = deque()
        self._bytes = 0
        # How many there were ever; where `_frames` has fewer than a listener missed, it begins again.
        self._made = 0
        self._since = history.order
        self._named = snapshots.named(mission)
        self._whole: tuple[int, bytes] | None = None
        self._changed = asyncio.Event()
        self._pulse: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._ticking = asyncio.create_task(self._tick(), name="live-updates")

    def change(self) -> None:
        """Something happened that the page shows."""
        self._changed.set()

    def wake(self) -> None:
        """Let every listener look again."""
        pulse, self._pulse = self._pulse, asyncio.get_running_loop().create_future()
        pulse.set_result(None)

    def close(self) -> None:
        """Make no more updates."""
        self._ticking.cancel()

    async def events(self, closing: Callable[[], bool]) -> AsyncIterator[bytes]:
        """A snapshot, then updates, and comments while there are none; ends when the mission does, or the service."""
        at = -1
        while not (closing() or self.gone):
            pulse = self._pulse
            missing = self._made - at
            if at < 0 or missing > len(self._frames):
                at = self._made
                yield self._snapshot()
            elif missing:
                frame = self._frames[-missing]
                at += 1
                yield frame
            elif not (await asyncio.wait({pulse}, timeout=_HEARTBEAT_S))[0]:
                yield b": nothing new\n\n"
        if self.gone:
            yield _event("gone", b"{}")

    async def _tick(self) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            began = time.perf_counter()
            try:
                self._advance()
            except Exception:
                log.exception("mission %s: its page gets no update; decisions go on", self.mission.mission_id)
            await asyncio.sleep(max(_PERIOD_S, (time.perf_counter() - began) / _SHARE))

    def _advance(self) -> None:
        """Make the next update."""
        named = snapshots.named(self.mission)
        if named != self._named:
            # Everyone needs a snapshot.
            self._named = named
            self._frames.clear()
            self._bytes = 0
        else:
            kept = self._history.of(self.mission.mission_id)
            self._keep(_event("update", snapshots.update(self.mission, kept, self._since)))
        self._since = self._history.order
        self._made += 1
        self.wake()

    def _keep(self, frame: bytes) -> None:
        self._frames.append(frame)
        self._bytes += len(frame)
        while len(self._frames) > _MOST_FRAMES or self._bytes > _MOST_BYTES:
            self._bytes -= len(self._frames.popleft())

    def _snapshot(self) -> bytes:
        """What came after it, and before the next update, is in that."""
        if self._whole is None or self._whole[0] != self._made:
            kept = self._history.of(self.mission.mission_id)[-_SHOWN:]
            self._whole = self._made, _event("snapshot", snapshots.snapshot(self.mission, kept, self._history.edge))
        return self._whole[1]


class Broadcaster:
    """What the engine tells, for those who watch; all of it on the event loop."""

    def __init__(self) -> None:
        self.history = RecentDecisions()
        self._watched: dict[str, MissionStream] = {}
        self._listeners = 0
        self._sending: set[asyncio.Timeout] = set()
        self._closing = False

    def decided(self, uav: UavState, prompt: Prompt, answer: DecideResponse) -> None:
        """Show an answered decision with its prompt, whether an LLM got the prompt or not."""
        self.history.decided((uav.position[0], uav.position[1]), prompt, answer)
        self._change(answer.mission_id)

    def settled(self, mission: Mission, outcome: Outcome) -> None:
        """An outcome was applied."""
        self.history.settled(outcome)
        self._change(mission.mission_id)

    def forget(self, mission_id: str) -> None:
        """The mission was deleted: who watches it is told."""
        self.history.forget(mission_id)
        if (watched := self._watched.pop(mission_id, None)) is not None:
            watched.gone = True
            watched.close()
            watched.wake()

    def close(self) -> None:
        """End every stream: at once where it is read, else a moment later."""
        self._closing = True
        for watched in self._watched.values():
            watched.wake()
        ends = asyncio.get_running_loop().time() + _LAST_S
        for limit in self._sending:
            limit.reschedule(min(limit.when() or ends, ends))

    @contextmanager
    def place(self) -> Iterator[None]:
        """A listener's place; raises ``Unavailable`` where there is none left."""
        if self._listeners >= MOST_LISTENERS or self._closing:
            raise Unavailable("mission_id", f"{MOST_LISTENERS} pages are watching already: close one")
        self._listeners += 1
        try:
            yield
        finally:
            self._listeners -= 1

    @asynccontextmanager
    async def sending(self) -> AsyncIterator[None]:
        """Around what waits for the network; raises ``TimeoutError`` where nobody reads."""
        async with asyncio.timeout(_LAST_S if self._closing else _STALLED_S) as limit:
            self._sending.add(limit)
            try:
                yield
            finally:
                self._sending.discard(limit)

    async def events(self, mission: Mission) -> AsyncGenerator[bytes]:
        """Of one mission, as server-sent events, for one listener that has its place."""
        watched = self._watched.get(mission.mission_id)
        if watched is None:
            watched = self._watched[mission.mission_id] = MissionStream(mission, self.history)
        watched.listeners += 1
        try:
            async for event in watched.events(lambda: self._closing):
                yield event
        finally:
            watched.listeners -= 1
            if watched.listeners == 0:
                watched.close()
                if self._watched.get(mission.mission_id) is watched:
                    del self._watched[mission.mission_id]

    def _change(self, mission_id: str) -> None:
        if (watched := self._watched.get(mission_id)) is not None:
            watched.change()


def _event(name: str, data: bytes) -> bytes:
    """JSON has no line breaks, so one ``data`` line holds it."""
    return b"event: %s\ndata: %s\n\n" % (name.encode(), data)
