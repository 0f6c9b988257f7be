"""HEAD, compression and the format of the metrics, over a real server."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from service.api.app import create_app
from service.config.settings import Settings
from tests.support.running import serving


@pytest.fixture(scope="module")
def edge() -> Iterator[httpx.Client]:
    with serving(create_app(Settings(mode="value"))) as url, httpx.Client(base_url=url, trust_env=False) as client:
        yield client


@pytest.mark.parametrize(
    "path", ["/", "/healthz", "/readyz", "/metrics", "/missions", "/openapi.json", "/static/main.js"]
)
def test_head_is_answered_as_get_without_a_body(edge: httpx.Client, path: str) -> None:
    head, got = edge.head(path), edge.get(path)
    assert head.status_code == got.status_code == 200 and head.content == b""
    assert head.headers["content-type"] == got.headers["content-type"]
    assert edge.head("/missions/none/guidance").status_code == 404


def test_a_stream_of_events_has_no_head(edge: httpx.Client) -> None:
    assert edge.head("/missions/default/events").status_code == 405


@pytest.mark.parametrize("path", ["/", "/static/main.js"])
def test_the_page_is_compressed_for_those_who_take_it(edge: httpx.Client, path: str) -> None:
    packed = edge.get(path, headers={"Accept-Encoding": "gzip"})
    plain = edge.get(path, headers={"Accept-Encoding": "identity"})
    assert packed.headers["content-encoding"] == "gzip" and "content-encoding" not in plain.headers
    assert packed.content == plain.content
    assert int(packed.headers["content-length"]) < len(plain.content) / 2


def test_metrics_have_the_format_that_is_asked_for(edge: httpx.Client) -> None:
    plain = edge.get("/metrics")
    assert plain.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    asked = edge.get("/metrics", headers={"Accept": "application/openmetrics-text;version=1.0.0,text/plain;q=0.5"})
    assert asked.headers["content-type"].startswith("application/openmetrics-text; version=1.0.0")
    assert asked.text.endswith("# EOF\n")
    names = {family.name for family in text_string_to_metric_families(asked.text)}  # type: ignore[no-untyped-call]
    assert "aicvds_decisions" in names and len(names) >= 35
    assert "_created" not in asked.text and "_created" not in plain.text


def test_the_stream_of_events_is_documented(edge: httpx.Client) -> None:
    document = edge.get("/openapi.json").json()
    answers = document["paths"]["/missions/{mission_id}/events"]["get"]["responses"]
    assert answers["200"]["content"] == {"text/event-stream": {"schema": {"type": "string"}}}
    assert "404" in answers
