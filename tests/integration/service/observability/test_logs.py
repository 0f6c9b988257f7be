"""No word of a client, an LLM or a server breaks a line of the log, or commands the terminal."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from service.observability import logs
from tests.integration.service.live.test_broadcaster import answer_of

_CODE = r"""
import logging, sys
from service.observability import logs

hostile = "x\r\n2026-01-01 [error] faked\x1b[31m\x00\x85\u2028\u202e" + "y" * 9
logs.configure("info", sys.argv[1])
log = logging.getLogger("service.llm")
log.warning("LLM degraded: %s", hostile, extra={"model": hostile})
log.warning(hostile)
try:
    raise ValueError("one")
except ValueError:
    log.exception("failed")
logs.hurry()
"""


@pytest.mark.parametrize("form", ["text", "json"])
def test_a_line_stays_a_line(form: str) -> None:
    done = subprocess.run([sys.executable, "-c", _CODE, form], capture_output=True, text=True, check=True)
    lines = done.stderr.splitlines()
    assert not any(line.startswith("2026-01-01") for line in lines)
    assert done.stderr.replace("\n", "").isprintable()
    first, second = lines[:2]
    assert first.count("faked") == 2 and second.count("faked") == 1
    if form == "json":
        assert [json.loads(line)["level"] for line in lines] == ["warning", "warning", "error"]
    else:
        # A traceback has its lines.
        assert lines[-1] == "ValueError: one" and len(lines) >= 5


def test_a_decision_past_its_deadline_is_a_warning_and_one_at_its_deadline_is_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    for total_ms in (3000.0, 3000.5):
        logs.decided(answer_of("a" * 32).model_copy(update={"latency_ms": {"total": total_ms}}), None)
    found = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert found == [("INFO", "decision"), ("WARNING", "late decision")]
