"""Several processes of one edge on PostgreSQL, where each has leases of its own: one is killed under load."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.shared_out import Report, outlive_a_kill, serving
from tests.faults.shared_store import Database

pytestmark = pytest.mark.faults


def test_a_killed_process_loses_nothing_in_postgresql(tmp_path: Path, report: Report) -> None:
    database = Database(tmp_path / "postgres")
    try:
        with serving(database.url, AICVDS_LEASE_S="8") as edge:
            outlive_a_kill(edge, report)
    finally:
        database.close()
