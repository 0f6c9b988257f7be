"""Fixtures shared by the laboratory's tests."""

from __future__ import annotations

from tests.unit.simulator.conftest import brief, unbounded, undrawn, without_extra

__all__ = ["brief", "unbounded", "undrawn", "without_extra"]
