"""What the process of ``aicvds mqtt`` loads, and that its messages do not reach the edge's process."""

from __future__ import annotations

import subprocess
import sys

_MODULES = ("field.commands.mqtt", *(f"field.lorawan.{name}" for name in ("edge_sender", "subscription")))
_ABSENT = ("torch", "fastapi", "sqlalchemy", "structlog", "pydantic_settings", "scipy", "uvicorn", "simulator")


def test_the_extra_mqtt_is_enough_for_it() -> None:
    imports = "; ".join(f"import {name}" for name in _MODULES)
    code = f"{imports}; import sys; print([name for name in {_ABSENT} if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


def test_an_edge_does_not_load_it() -> None:
    code = "import service.api.app, sys; print([m for m in sys.modules if m.split('.')[0] == 'paho' or 'lorawan' in m])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
