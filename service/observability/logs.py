"""Logs, as text for people or as JSON for machines; each line of a request has the fields bound to that request."""

import atexit
import logging
import logging.handlers
import queue
import sys
import threading
import time
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Any, Literal

import structlog
from structlog.typing import Processor

from shared.wire.schemas import DecideResponse

log = logging.getLogger(__name__)

_MOST_WAITING = 10_000
# The fields of an answer that its line has.
_LOGGED = ("decision_id", "mission_id", "uav_id", "step", "sensor_id", "velocity", "source", "reason", "model")
# The longest wait for the last lines of a process.
_LAST_LINES_S = 1.0


class _ThreadedHandler(logging.handlers.QueueHandler):
    """Writes to stderr from a thread, so that no decision waits for a slow disk or a reader that has stopped.

    Lines that do not fit into the queue are dropped; their number is logged when there is room again.
    """

    queue: queue.Queue[str | None]

    def start(self) -> None:
        """Start the thread, which writes until the process ends, and then the queued lines for up to a second."""
        self._dropped = 0
        self._ends = 0.0
        self._writer = threading.Thread(target=self._write, name="logs", daemon=True)
        self._writer.start()
        atexit.register(self._end)

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue a line without waiting, except after :meth:`hurry`."""
        try:
            self.queue.put_nowait(record.getMessage())
            if self._dropped:
                message = "%d lines of the log were dropped: stderr is too slow"
                dropped = logging.LogRecord(__name__, logging.WARNING, __file__, 0, message, (self._dropped,), None)
                self.queue.put_nowait(self.format(dropped))
                self._dropped = 0
        except queue.Full:
            self._dropped += 1
        while self._ends and self.queue.unfinished_tasks and time.monotonic() < self._ends:
            time.sleep(0.002)

    def hurry(self) -> None:
        """Let each further line wait until it is written, a second in all: the process may end at any moment."""
        self._ends = time.monotonic() + _LAST_LINES_S

    def _write(self) -> None:
        while (line := self.queue.get()) is not None:
            # The fault may be temporary, such as a full disk.
            with suppress(OSError, ValueError):
                print(line, file=sys.stderr, flush=True)
            self.queue.task_done()

    def _end(self) -> None:
        with suppress(queue.Full):
            self.queue.put_nowait(None)
        self._writer.join(timeout=_LAST_LINES_S)


def configure(level: str, form: Literal["text", "json"]) -> None:
    """Send every log of this process to stderr; the ``extra`` of ``logging`` and bound names become fields."""
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        _without_colours,
        _on_one_line,
    ]
    renderers: list[Processor] = (
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
        if form == "json"
        # The other exception formatters print local variables, API keys among them.
        else [
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback)
        ]
    )
    handler = _ThreadedHandler(queue.Queue(_MOST_WAITING))
    processors: list[Processor] = [structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers]
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=processors))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    handler.start()
    # At level info httpx logs every request with its address.
    logging.getLogger("httpx").setLevel(logging.WARNING)
    if level != "debug":
        # At level info alembic logs each of its plugins, even without a migration.
        logging.getLogger("alembic").setLevel(logging.WARNING)


def _without_colours(_: object, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Drop uvicorn's second copy of its message, which has a terminal's colour codes."""
    event.pop("color_message", None)
    return event


def _on_one_line(_: object, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Escape what would begin a line of its own or command a terminal: words of clients and LLMs are in the log too."""
    for name, value in event.items():
        if isinstance(value, str) and not value.isprintable():
            event[name] = "".join(c if c.isprintable() else repr(c)[1:-1] for c in value.strip())
    return event


def hurry() -> None:
    """Let each further line wait until it is written: a signal may end the process at any moment."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, _ThreadedHandler):
            handler.hurry()


def decided(answer: DecideResponse, trace_id: str | None) -> None:
    """Log an answered decision, with its trace where there is one; at level warning where it was late."""
    late = answer.latency_ms["total"] > answer.deadline_ms
    log.log(
        logging.WARNING if late else logging.INFO,
        "late decision" if late else "decision",
        extra={
            **{name: getattr(answer, name) for name in _LOGGED},
            "total_ms": answer.latency_ms["total"],
            "llm_ms": answer.latency_ms.get("llm"),
            "stored": answer.stored,
            **({} if trace_id is None else {"trace_id": trace_id}),
        },
    )
