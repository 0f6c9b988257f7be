"""Logs, as text for people or as JSON for machines: what is bound to a request stands in each of its lines."""

from __future__ import annotations

import atexit
import logging
import logging.handlers
import queue
import sys
import threading
import time
from contextlib import suppress
from typing import Literal

import structlog
from structlog.typing import Processor

from shared.wire import DecideResponse

log = logging.getLogger(__name__)

_MOST_WAITING = 10_000
_LAST_WORDS_S = 1.0


class _Patient(logging.handlers.QueueHandler):
    """Writes to stderr from a thread of its own: where nobody reads it, or its disk is slow, no decision waits for it.

    What does not fit into the queue is dropped, and how much that was is told when there is room again.
    """

    queue: queue.Queue[str | None]

    def start(self) -> None:
        """Begin to write, until the process ends; then what is waiting gets a moment."""
        self._dropped = 0
        self._ends = 0.0
        self._writer = threading.Thread(target=self._write, name="logs", daemon=True)
        self._writer.start()
        atexit.register(self._end)

    def enqueue(self, record: logging.LogRecord) -> None:
        """Never waits, but for the last lines: see :meth:`hurry`."""
        try:
            self.queue.put_nowait(record.getMessage())
            if self._dropped:
                said = "%d lines of the log were dropped: nobody took them"
                about = logging.LogRecord(__name__, logging.WARNING, __file__, 0, said, (self._dropped,), None)
                self.queue.put_nowait(self.format(about))
                self._dropped = 0
        except queue.Full:
            self._dropped += 1
        while self._ends and self.queue.unfinished_tasks and time.monotonic() < self._ends:
            time.sleep(0.002)

    def hurry(self) -> None:
        """The process may end any moment: from now on lines are waited for, a second in all."""
        self._ends = time.monotonic() + _LAST_WORDS_S

    def _write(self) -> None:
        while (line := self.queue.get()) is not None:
            # A full disk, say; it may have room again.
            with suppress(OSError, ValueError):
                print(line, file=sys.stderr, flush=True)
            self.queue.task_done()

    def _end(self) -> None:
        with suppress(queue.Full):
            self.queue.put_nowait(None)
        self._writer.join(timeout=_LAST_WORDS_S)


def configure(level: str, form: Literal["text", "json"]) -> None:
    """Send every log of this process to stderr in this form; ``logging``'s ``extra`` and bound names become fields."""
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    ending: list[Processor] = (
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
        if form == "json"
        # The other formatters print local variables, keys among them.
        else [
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback)
        ]
    )
    handler = _Patient(queue.Queue(_MOST_WAITING))
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared, processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *ending]
        )
    )
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    handler.start()
    # httpx logs every request at level info, address included.
    logging.getLogger("httpx").setLevel(logging.WARNING)


def hurry() -> None:
    """The process may end any moment, by a signal that leaves no time: lines are waited for from now on."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, _Patient):
            handler.hurry()


def bind(mission_id: str, step: int) -> None:
    """Name these in every line of the request at hand."""
    structlog.contextvars.clear_contextvars()
    structlog.contextvars.bind_contextvars(mission_id=mission_id, step=step)


def decided(answer: DecideResponse) -> None:
    """One line a decision; at level warning where it was late."""
    late = answer.latency_ms["total"] > answer.deadline_ms
    log.log(
        logging.WARNING if late else logging.INFO,
        "late decision" if late else "decision",
        extra={
            "decision_id": answer.decision_id,
            "mission_id": answer.mission_id,
            "uav_id": answer.uav_id,
            "step": answer.step,
            "sensor_id": answer.sensor_id,
            "velocity": answer.velocity,
            "source": answer.source,
            "reason": answer.reason,
            "model": answer.model,
            "total_ms": answer.latency_ms["total"],
            "llm_ms": answer.latency_ms.get("llm"),
            "stored": answer.stored,
        },
    )
