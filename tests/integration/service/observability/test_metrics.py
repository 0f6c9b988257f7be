"""What Prometheus is told of learning and of the queues."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import httpx
import pytest
from prometheus_client import CollectorRegistry

from service.observability.metrics import ArrayHistogram, Metrics
from tests.integration.service.live.test_broadcaster import answer_of
from tests.support.places import ROOT
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def numbers(client: httpx.Client) -> dict[str, float]:
    """The edge's numbers by series."""
    lines = (line.rsplit(" ", 1) for line in client.get("/metrics").text.splitlines() if not line.startswith("#"))
    return {series: float(number) for series, number in lines}


def test_every_update_counts_with_its_loss(edge: Edge, report: Report) -> None:
    client, outcome = edge(), None
    for step in range(6):
        answer = client.post("/decide", json=report(step=step, outcome=outcome)).json()
        outcome = {"decision_id": answer["decision_id"], "cost": 2.0}
    until(lambda: numbers(client)["aicvds_learner_update_loss_count"] >= 5)
    reported = numbers(client)
    assert reported["aicvds_learner_update_loss_count"] == 5
    assert reported["aicvds_learner_update_loss_sum"] > reported["aicvds_learner_loss"] > 0
    last = client.get("/missions/test").json()["learner_loss"]
    assert reported["aicvds_learner_loss"] == pytest.approx(last)


def test_full_queues_are_a_risk_and_empty_ones_are_none(edge: Edge, report: Report) -> None:
    client, totals = edge(), []
    for packets in (0, 60):
        body = report(mission_id=f"queues-of-{packets}")
        sensors = body["sensors"]
        sensors.update({name: column[:4] for name, column in sensors.items()})
        sensors["queue"] = [packets] * 4
        assert client.post("/decide", json=body).status_code == 200
        totals.append(numbers(client)["aicvds_overflow_risk_sum"])
    assert totals[0] < 0.05
    assert totals[1] - totals[0] > 0.95


def test_the_version_is_that_of_the_package(edge: Edge) -> None:
    client = edge()
    assert numbers(client)[f'aicvds_build_info{{version="{version("aic-vds")}"}}'] == 1
    assert client.get("/openapi.json").json()["info"]["version"] == version("aic-vds")


def test_without_an_llm_no_breaker_is_open(edge: Edge) -> None:
    reported = numbers(edge())
    assert reported["aicvds_llm_breaker_open"] == 0
    by_status = {series: n for series, n in reported.items() if series.startswith("aicvds_llm_servers")}
    assert by_status == {
        f'aicvds_llm_servers{{status="{status}"}}': float(status == "off")
        for status in ("loading", "ready", "degraded", "unavailable", "off")
    }


def test_the_docs_name_every_metric_with_its_labels() -> None:
    page = (ROOT / "docs" / "reference" / "metrics.md").read_text(encoding="utf-8")
    named = {
        row[1].strip(" `"): (row[2].strip(), re.findall(r"`(\w+)`", row[3]))
        for row in (line.split("|") for line in page.splitlines() if line.startswith("| `aicvds_"))
    }
    ends = {"counter": "_total", "info": "_info"}
    collectors: list[Any] = [
        c for c in Metrics().registry._collector_to_names if getattr(c, "_name", "").startswith("aicvds")
    ]
    kinds = [(c._name, getattr(c, "_type", "histogram"), getattr(c, "_labelnames", ())) for c in collectors]
    assert named == {name + ends.get(kind, ""): (kind, list(labels)) for name, kind, labels in kinds}


def test_a_decision_counts_with_its_lateness_its_overhead_and_its_tokens() -> None:
    metrics = Metrics()

    def found(name: str, **labels: str) -> float | None:
        return metrics.registry.get_sample_value(name, labels)

    timely = answer_of("a" * 32).model_copy(update={"latency_ms": {"llm": 2000.0, "total": 3000.0}})
    usage = {"saved": 30, "server_prompt": 500, "cached": 400, "completion": 2}
    late = timely.model_copy(
        update={
            "latency_ms": {"llm": 2500.0, "total": 3000.5},
            "tokens": timely.tokens.model_copy(update=usage),
            "source": "llm",
            "reason": None,
        }
    )
    uncached = late.model_copy(update={"tokens": late.tokens.model_copy(update={"cached": None, "completion": None})})
    metrics.record_decision(timely, None)
    assert found("aicvds_deadline_missed_total") == 0
    assert found("aicvds_llm_tokens_total", kind="prompt") in (None, 0)
    metrics.record_decision(late, None)
    metrics.record_decision(uncached, None)
    assert found("aicvds_deadline_missed_total") == 2
    assert found("aicvds_overhead_seconds_sum") == pytest.approx(1.0 + 2 * 0.5005)
    assert found("aicvds_decision_seconds_sum", stage="llm") == pytest.approx(7.0)
    assert found("aicvds_decisions_total", source="value", reason="mode_value") == 1
    assert found("aicvds_decisions_total", source="llm", reason="none") == 2
    kinds = ("prompt", "cached", "completion")
    assert [found("aicvds_llm_tokens_total", kind=kind) for kind in kinds] == [1000, 400, 2]
    assert found("aicvds_tokens_saved_total") == 60


def test_a_value_at_a_bound_is_in_the_bounds_bucket() -> None:
    registry = CollectorRegistry()
    ArrayHistogram("excess_db", "Excess", registry, (-1.0, 0.0, 1.0)).observe([-1.0, -0.5, 0.0, 1.0, 1.5])
    found = [registry.get_sample_value("excess_db_bucket", {"le": le}) for le in ("-1.0", "0.0", "1.0", "+Inf")]
    assert found == [1, 3, 4, 5]
    assert (registry.get_sample_value("excess_db_count"), registry.get_sample_value("excess_db_sum")) == (5, 1.0)
