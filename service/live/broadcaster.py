"""Live updates of missions for their pages: at most ten a second for each mission, made once for all its listeners.

A listener takes the next update when the network has accepted the one before. A slow listener costs no more than its
slot: the updates that it misses are dropped, and it continues from a snapshot. A mission without listeners has no task.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager

from service.errors import Unavailable
from service.live import snapshots
from service.live.fleet_watch import FleetWatch, Watched
from service.live.recent_decisions import RecentDecisions
from service.mission.mission import Mission
from service.prompting.prompt import Prompt
from shared.wire.schemas import DecideResponse, Outcome, UavState

log = logging.getLogger(__name__)

# Listeners of all missions together.
MAX_LISTENERS = 32
_PERIOD_S, _LONGEST_PERIOD_S = 0.1, 2.0
# The largest share of the event loop's time for updates: one for 2,000 sensors takes milliseconds.
_SHARE = 0.05
# The backlog of updates for late listeners, in number and in bytes.
_MOST_FRAMES, _MOST_BYTES = 30, 1_000_000
# Decisions in a snapshot.
_SHOWN = 300
HEARTBEAT_S = 5.0
# A listener that accepts nothing for this long has stopped reading. The limit is shorter while the service closes.
_STALLED_S, _LAST_S = 20.0, 0.5


class MissionStream:
    """The updates of one mission that has listeners."""

    def __init__(self, mission: Mission, history: RecentDecisions, watched: Watched) -> None:
        self.mission = mission
        self.listeners = 0
        self.deleted = False
        self._history = history
        self._watched = watched
        self._frames: deque[bytes] = deque()
        self._bytes = 0
        # The number of updates so far. A listener that missed more than `_frames` has gets a snapshot.
        self._made = 0
        self._since = history.order
        self._places = snapshots.drawn_places(mission)
        self._last_snapshot: tuple[tuple[int, int], bytes] | None = None
        self._changed = asyncio.Event()
        self._next_update: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._ticking = asyncio.create_task(self._tick(), name="live-updates")

    def change(self) -> None:
        """Record that the page's content has changed."""
        self._changed.set()

    def notify(self) -> None:
        """Resume every listener that waits for an update."""
        due, self._next_update = self._next_update, asyncio.get_running_loop().create_future()
        due.set_result(None)

    def close(self) -> None:
        """Stop making updates."""
        self._ticking.cancel()

    async def events(self, closing: Callable[[], bool]) -> AsyncIterator[bytes]:
        """A snapshot, then updates, and comments while there are none.

        The events end when the mission is deleted or the service closes.
        """
        at = -1
        while not (closing() or self.deleted):
            next_update = self._next_update
            missing = self._made - at
            if at < 0 or missing > len(self._frames):
                at = self._made
                yield self._snapshot()
            elif missing:
                frame = self._frames[-missing]
                at += 1
                yield frame
            elif not (await asyncio.wait({next_update}, timeout=HEARTBEAT_S))[0]:
                yield b": nothing new\n\n"
        if self.deleted:
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
            await asyncio.sleep(pause_s(time.perf_counter() - began))

    def _advance(self) -> None:
        """Make the next update."""
        places = snapshots.drawn_places(self.mission)
        if places != self._places:
            # The page draws positions from a snapshot only, so every listener gets one.
            self._places = places
            self._frames.clear()
            self._bytes = 0
        else:
            decisions = self._history.of(self.mission.mission_id)
            self._add(_event("update", snapshots.update(self.mission, decisions, self._watched, self._since)))
        self._since = self._history.order
        self._made += 1
        self.notify()

    def _add(self, frame: bytes) -> None:
        self._frames.append(frame)
        self._bytes += len(frame)
        while len(self._frames) > _MOST_FRAMES or self._bytes > _MOST_BYTES:
            self._bytes -= len(self._frames.popleft())

    def _snapshot(self) -> bytes:
        """The snapshot at the last update, the same for a second; the next update has every later change."""
        made = self._made, int(time.monotonic())  # It has the seconds since the newest decision and reports.
        if self._last_snapshot is None or self._last_snapshot[0] != made:
            decisions = self._history.of(self.mission.mission_id)[-_SHOWN:]
            shown = snapshots.snapshot(self.mission, decisions, self._watched, self._history.edge)
            self._last_snapshot = made, _event("snapshot", shown)
        return self._last_snapshot[1]


class Broadcaster:
    """Distributes decisions and outcomes to the listeners of their missions; only the event loop uses it."""

    def __init__(self) -> None:
        self.history = RecentDecisions()
        self.watch = FleetWatch()
        self._streams: dict[str, MissionStream] = {}
        self._listeners = 0
        self._sending: set[asyncio.Timeout] = set()
        self._closing = False

    def decided(self, mission: Mission, uav: UavState, prompt: Prompt, answer: DecideResponse) -> None:
        """Show an answered decision with its prompt, even if no LLM received it."""
        self.watch.decided(mission, uav, answer.step)
        self.history.decided((uav.position[0], uav.position[1]), prompt, answer)
        self.changed(answer.mission_id)

    def changed(self, mission_id: str) -> None:
        """Record that the content of the mission's page has changed."""
        if (stream := self._streams.get(mission_id)) is not None:
            stream.change()

    def outcome_applied(self, mission: Mission, outcome: Outcome) -> None:
        """Show an outcome that is applied."""
        self.history.outcome_applied(outcome)
        self.changed(mission.mission_id)

    def forget(self, mission_id: str) -> None:
        """Forget a deleted mission, and notify its listeners."""
        self.history.forget(mission_id)
        self.watch.forget(mission_id)
        if (stream := self._streams.pop(mission_id, None)) is not None:
            stream.deleted = True
            stream.close()
            stream.notify()

    def close(self) -> None:
        """End every stream: immediately if its listener reads, otherwise after half a second."""
        self._closing = True
        for stream in self._streams.values():
            stream.notify()
        ends = asyncio.get_running_loop().time() + _LAST_S
        for limit in self._sending:
            if not limit.expired():
                limit.reschedule(min(limit.when() or ends, ends))

    @contextmanager
    def listener(self) -> Iterator[None]:
        """A listener's slot; raises ``Unavailable`` if none is free."""
        if self._listeners >= MAX_LISTENERS or self._closing:
            raise Unavailable("mission_id", f"{MAX_LISTENERS} pages listen already: close one")
        self._listeners += 1
        try:
            yield
        finally:
            self._listeners -= 1

    @asynccontextmanager
    async def sending(self) -> AsyncIterator[None]:
        """The time limit around sending; raises ``TimeoutError`` if the listener does not read."""
        async with asyncio.timeout(_LAST_S if self._closing else _STALLED_S) as limit:
            self._sending.add(limit)
            try:
                yield
            finally:
                self._sending.discard(limit)

    async def events(self, mission: Mission) -> AsyncGenerator[bytes]:
        """One mission's server-sent events, for one listener that has a slot."""
        stream = self._streams.get(mission.mission_id)
        if stream is None:
            stream = self._streams[mission.mission_id] = MissionStream(
                mission, self.history, self.watch.of(mission.mission_id)
            )
        stream.listeners += 1
        try:
            async for event in stream.events(lambda: self._closing):
                yield event
        finally:
            stream.listeners -= 1
            if stream.listeners == 0:
                stream.close()
                if self._streams.get(mission.mission_id) is stream:
                    del self._streams[mission.mission_id]


def pause_s(took_s: float) -> float:
    """The seconds between two updates, by those that the last one took; a stall delays the next by little."""
    return min(max(_PERIOD_S, took_s / _SHARE), _LONGEST_PERIOD_S)


def _event(name: str, data: bytes) -> bytes:
    """A server-sent event; JSON has no line breaks, so one ``data`` line is enough."""
    return b"event: %s\ndata: %s\n\n" % (name.encode(), data)
