"""Fixtures of the service's tests."""

from __future__ import annotations

from tests.support.service_fixtures import address, left_alone, made_missions, postgres

__all__ = ["address", "left_alone", "made_missions", "postgres"]
