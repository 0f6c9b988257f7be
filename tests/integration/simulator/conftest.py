"""Fixtures of the simulator's tests."""

from __future__ import annotations

from tests.support.simulator_fixtures import brief, unbounded, undrawn, without_extra

__all__ = ["brief", "unbounded", "undrawn", "without_extra"]
