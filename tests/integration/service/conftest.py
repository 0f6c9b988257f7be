"""Fixtures of the service's tests."""

from __future__ import annotations

from tests.support.service_fixtures import address, briefly_planned, left_alone, made_missions, postgres

__all__ = ["address", "briefly_planned", "left_alone", "made_missions", "postgres"]
