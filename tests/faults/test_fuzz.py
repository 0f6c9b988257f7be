"""schemathesis, 10,000 cases: without keys, with the right one, and with wrong ones, on a real process with a store."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.core.result import Ok

from tests.faults.table import Tables
from tests.support.processes import run, serving_edge
from tests.support.waiting import PATIENCE_S

pytestmark = [pytest.mark.fuzz, pytest.mark.timeout(1800)]

CASES = 10_000
OPEN = ("/healthz", "/readyz")


def operations_of(schema: schemathesis.BaseSchema) -> list[Any]:
    """All but the endless stream of events; a schema that cannot be read fails here."""
    every = [result.ok() for result in schema.get_all_operations() if isinstance(result, Ok)]
    return [operation for operation in every if not operation.path.endswith("/events")]


def fuzz(url: str, headers: dict[str, str], cases: int) -> Counter[tuple[str, int]]:
    """Statuses by path of so many cases, of all operations alike."""
    # An edge that loads answers later than schemathesis waits.
    httpx.get(f"{url}/openapi.json", headers=headers, timeout=PATIENCE_S).raise_for_status()
    schema = schemathesis.openapi.from_url(f"{url}/openapi.json", headers=headers)
    operations = operations_of(schema)
    statuses: Counter[tuple[str, int]] = Counter()
    asking = [operation for operation in operations if operation.method.upper() in ("POST", "PUT")]
    for operation in operations:
        # Those with bodies get nearly all: the others have an ID to get wrong, or nothing.
        share = 0.9 / len(asking) if operation in asking else 0.1 / (len(operations) - len(asking))
        # Without a parameter or a body there is nothing to get wrong.
        some = {"parameters", "requestBody"} & operation.definition.raw.keys()
        for mode in list(GenerationMode) if some else [GenerationMode.POSITIVE]:
            strategy = operation.as_strategy(generation_mode=mode)

            @given(case=strategy)
            @settings(
                max_examples=max(1, round(cases * share / 2)),
                deadline=None,
                derandomize=True,
                suppress_health_check=list(HealthCheck),
                database=None,
            )
            def holds(case: schemathesis.Case[Any]) -> None:
                answer = case.call(headers=headers)
                statuses[case.path, answer.status_code] += 1
                case.validate_response(answer, checks=[not_a_server_error])

            holds()
    return statuses


def reported(statuses: Counter[tuple[str, int]]) -> str:
    by_status: Counter[int] = Counter()
    for (_, status), count in statuses.items():
        by_status[status] += count
    return ", ".join(f"{status}: {count}" for status, count in sorted(by_status.items()))


def test_ten_thousand_cases(tmp_path: Path, tables: Tables) -> None:
    keys = tmp_path / "keys.json"
    made = run("keys", "add", "f", "--file", str(keys), "--scopes", "decide", "admin", "--per-minute", "1000000")
    right = {"Authorization": f"Bearer {made.stdout.strip()}"}
    common = {"AICVDS_MODE": "value", "AICVDS_MAX_MISSIONS": "1000000", "AICVDS_LOG_LEVEL": "error"}
    rows = []
    with serving_edge(**common, AICVDS_STORE=str(tmp_path / "open.db")) as (url, _):
        rows.append(("no keys are asked for", fuzz(url, {}, CASES // 2)))
    with serving_edge(**common, AICVDS_STORE=str(tmp_path / "keys.db"), AICVDS_KEYS=str(keys)) as (url, _):
        rows.append(("the right key", fuzz(url, right, CASES // 2)))
        # The schema is behind the door too.
        wrong = schemathesis.openapi.from_url(f"{url}/openapi.json", headers=right)
        refused: Counter[tuple[str, int]] = Counter()
        for operation in operations_of(wrong):

            @given(case=operation.as_strategy())
            @settings(max_examples=60, deadline=None, derandomize=True, database=None)
            def holds(case: schemathesis.Case[Any]) -> None:
                for headers in ({}, {"Authorization": "Bearer nobody"}):
                    answer = case.call(headers=headers)
                    refused[case.path, answer.status_code] += 1

            holds()
        rows.append(("no key, and a wrong one", refused))
    for who, statuses in rows:
        tables.add("schemathesis", who=who, cases=sum(statuses.values()), statuses=reported(statuses))
    assert sum(sum(statuses.values()) for _, statuses in rows) >= CASES
    assert [s for _, statuses in rows for (_, s) in statuses if s >= 500] == []
    assert {status for (path, status) in refused if path not in OPEN} == {401}
