"""Logs and traces of a real edge: every line and span says whose it is, and none of them tells a secret."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from service.config.settings import Settings
from service.observability.tracing import Traces
from tests.integration.service.live.test_broadcaster import answer_of
from tests.support.processes import run, serving_edge
from tests.support.running import listening, serving
from tests.support.stub_llm import StubLlm, http_answer, misbehaving, wait_for
from tests.support.waiting import PATIENCE_S

Report = Callable[..., dict[str, Any]]


@pytest.mark.long
def test_each_line_is_json_and_names_the_mission_and_decision_and_no_secret(tmp_path: Path, report: Report) -> None:
    keys = tmp_path / "keys.json"
    key = run("keys", "add", "fleet", "--file", str(keys), "--scopes", "decide", "admin").stdout.strip()
    with (
        listening(misbehaving(http_answer(b"500 Oops", b"no such key: secret-of-the-llm"))) as llm,
        serving_edge(
            AICVDS_MODE="llm",
            AICVDS_LLM_URL=f"{llm}/v1",
            AICVDS_LLM_API_KEY="secret-of-the-llm",
            AICVDS_KEYS=str(keys),
            AICVDS_LOG_FORMAT="json",
            AICVDS_LOG_LEVEL="debug",
        ) as (url, process),
        httpx.Client(base_url=url, timeout=PATIENCE_S, headers={"Authorization": f"Bearer {key}"}) as client,
    ):
        wait_for(client, "ready")
        answers = [client.post("/decide", json=report(step=step)).json() for step in range(4)]
        client.post("/decide", json=report(step="no number"))
        process.terminate()
        output = process.communicate(timeout=PATIENCE_S)[0]
    lines = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    decisions = [line for line in lines if line["event"] in ("decision", "late decision")]
    assert [line["decision_id"] for line in decisions] == [answer["decision_id"] for answer in answers]
    assert {(line["mission_id"], line["uav_id"], line["source"]) for line in decisions} == {("test", 0, "policy")}
    assert [line["step"] for line in decisions] == [0, 1, 2, 3]
    # What is logged on the way says whose decision it is about.
    opened = next(line for line in lines if "failed too often" in line["event"])
    assert (opened["mission_id"], opened["step"], opened["level"]) == ("test", 2, "warning")
    for secret in (key, "secret-of-the-llm"):
        assert secret not in output


class _Collector(BaseHTTPRequestHandler):
    received: list[Span]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Content-Encoding") == "gzip":
            import gzip

            body = gzip.decompress(body)
        request = ExportTraceServiceRequest.FromString(body)
        for resource in request.resource_spans:
            for scope in resource.scope_spans:
                type(self).received.extend(scope.spans)
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def collecting() -> Iterator[tuple[str, list[Span]]]:
    spans: list[Span] = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Collector", (_Collector,), {"received": spans}))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}", spans
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def reported(span: Span) -> dict[str, Any]:
    return {a.key: getattr(a.value, a.value.WhichOneof("value") or "string_value") for a in span.attributes}


def test_a_decision_is_a_trace_under_its_callers(report: Report) -> None:
    trace, parent = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
    with (
        collecting() as (collector, spans),
        serving(StubLlm().app) as llm,
        serving_edge(AICVDS_MODE="llm", AICVDS_LLM_URL=f"{llm}/v1", OTEL_EXPORTER_OTLP_ENDPOINT=collector) as (
            url,
            process,
        ),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
    ):
        wait_for(client, "ready")
        headers = {"traceparent": f"00-{trace}-{parent}-01"}
        answer = client.post("/decide", json=report(), headers=headers).json()
        assert answer["source"] == "llm"
        assert client.post("/decide", json={}, headers=headers).status_code == 422
        measured = client.get("/metrics", headers={"Accept": "application/openmetrics-text"}).text
        process.terminate()
        logged = process.communicate(timeout=PATIENCE_S)[0]
    total = [line for line in measured.splitlines() if line.startswith('aicvds_decision_seconds_bucket{le="')]
    assert any(f'# {{trace_id="{trace}"}}' in line for line in measured.splitlines()), total
    assert f"trace_id={trace}" in logged
    assert any("refused a request" in line and headers["traceparent"] in line for line in logged.splitlines())
    whole = next(span for span in spans if span.name == "decide")
    assert (whole.trace_id.hex(), whole.parent_span_id.hex()) == (trace, parent)
    assert reported(whole)["aicvds.decision_id"] == answer["decision_id"]
    inside = {span.name: span for span in spans if span.parent_span_id == whole.span_id}
    assert {"augment", "attend", "prompt", "check", "store", "chat stub-1"} <= inside.keys()
    asked = inside["chat stub-1"]
    assert asked.kind == Span.SPAN_KIND_CLIENT
    about = reported(asked)
    assert about["gen_ai.operation.name"] == "chat"
    assert about["gen_ai.request.model"] == "stub-1"
    assert about["server.address"] == "127.0.0.1"
    assert whole.start_time_unix_nano <= asked.start_time_unix_nano <= asked.end_time_unix_nano
    assert asked.end_time_unix_nano <= whole.end_time_unix_nano


@pytest.mark.long
def test_an_llm_that_fails_is_an_error_in_the_trace(report: Report) -> None:
    with (
        collecting() as (collector, spans),
        listening(misbehaving(http_answer(b"500 Oops", b"oops"))) as llm,
        serving_edge(AICVDS_MODE="llm", AICVDS_LLM_URL=f"{llm}/v1", OTEL_EXPORTER_OTLP_ENDPOINT=collector) as (
            url,
            process,
        ),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
    ):
        wait_for(client, "ready")
        client.post("/decide", json=report())
        process.terminate()
        process.communicate(timeout=PATIENCE_S)
    asked = next(span for span in spans if span.name.startswith("chat"))
    assert reported(asked)["error.type"] == "llm_status"
    assert asked.status.code == 2


@pytest.mark.long
def test_a_log_that_nobody_reads_keeps_no_uav_waiting(report: Report) -> None:
    """A pipe holds 64 KB; past that, who writes to it waits."""
    with (
        serving_edge(AICVDS_MODE="value", AICVDS_LOG_LEVEL="debug") as (url, process),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
    ):
        for step in range(600):
            assert client.post("/decide", json=report(step=step)).status_code == 200
        process.terminate()
        # Nor is the end waited for.
        assert process.wait(PATIENCE_S) in (0, -15)


def test_the_spans_of_a_decision_follow_each_other_and_the_llms_has_its_server_and_tokens() -> None:
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    answer = answer_of("a" * 32)
    tokens = answer.tokens.model_copy(update={"server_prompt": 500, "completion": 2})
    stages = {"prompt": 10.0, "llm": 200.0, "store": 30.0, "total": 240.0}
    answer = answer.model_copy(update={"latency_ms": stages, "tokens": tokens, "model": "m"})
    for url, port in (("https://llm/v1", 443), ("http://llm/v1", 80), ("http://llm:8080/v1", 8080)):
        exporter.clear()
        Traces(provider, Settings(mode="llm", llm_url=url)).decided(answer)
        spans = {span.name: span for span in exporter.get_finished_spans()}
        times = [
            (one.start_time or 0, one.end_time or 0) for one in map(spans.get, ("prompt", "chat m", "store")) if one
        ]
        assert [ended - began for began, ended in times] == [10_000_000, 200_000_000, 30_000_000]
        assert [ended for _, ended in times[:2]] == [began for began, _ in times[1:]]
        about = spans["chat m"].attributes or {}
        assert (about["server.address"], about["server.port"]) == ("llm", port)
        assert (about["gen_ai.usage.input_tokens"], about["gen_ai.usage.output_tokens"]) == (500, 2)
