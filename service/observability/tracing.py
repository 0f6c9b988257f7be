"""OpenTelemetry traces (extra ``otel``): a span for each decision, with a span for each stage.

Spans go to the standard ``OTEL_EXPORTER_OTLP_ENDPOINT``; without it, or without the extra, there are none. A request's
``traceparent`` is the decision's parent. The LLM's stage is a client span, which follows the semantic conventions for
generative AI. It has neither prompt nor answer.
"""

import logging
import os
import time
from typing import TYPE_CHECKING, Any

from starlette.types import ASGIApp, Receive, Scope, Send

from service.config.settings import Settings
from shared.wire.reasons import LLM_FAILURES
from shared.wire.schemas import DecideResponse

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

log = logging.getLogger(__name__)

_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")


def provider_from_environment(version: str) -> "TracerProvider | None":
    """A provider that exports over OTLP; None without an endpoint in the environment, or without the extra."""
    if not any(os.environ.get(name) for name in _ENDPOINTS):
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        log.warning("%s is set, but the extra otel is not installed: no traces", _ENDPOINTS[0])
        return None
    provider = TracerProvider(resource=Resource.create({"service.name": "aic-vds-edge", "service.version": version}))
    # At its end the edge waits for the exporter, and `docker stop` waits 10 s for the edge.
    timeout_s = None if any(name.endswith("TIMEOUT") for name in os.environ if name.startswith("OTEL_")) else 1.5
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(timeout=timeout_s)))
    return provider


class Traces:
    """Records decisions, if there is a provider."""

    def __init__(self, provider: "TracerProvider | None", settings: Settings) -> None:
        self.provider = provider
        self._tracer = None if provider is None else provider.get_tracer("aic_vds.edge")
        self._server = _address(settings.llm_url)
        self._vendor = "openai" if settings.llm_url else "llama.cpp"

    def decided(self, answer: DecideResponse) -> str | None:
        """Record the spans of a decision that has just been answered, and return the trace's ID as 32 hex digits.

        The spans follow from the times of the decision's consecutive stages. Without a provider there is no ID. The
        decisions of a batch are answered together, so their spans all end now.
        """
        if self._tracer is None:
            return None
        from opentelemetry import trace
        from opentelemetry.trace import SpanKind, Status, StatusCode

        ended = time.time_ns()
        started = ended - _ns(answer.latency_ms["total"])
        attributes = _attributes(answer)
        whole = self._tracer.start_span("decide", kind=SpanKind.SERVER, start_time=started, attributes=attributes)
        inside = trace.set_span_in_context(whole)
        for stage, milliseconds in answer.latency_ms.items():
            if stage == "total":
                continue
            until = started + _ns(milliseconds)
            if stage == "llm":
                attributes = self._llm_attributes(answer)
                name, kind = f"chat {answer.model or 'unknown'}", SpanKind.CLIENT
            else:
                attributes, name, kind = {}, stage, SpanKind.INTERNAL
            span = self._tracer.start_span(name, inside, kind, attributes, start_time=started)
            if "error.type" in attributes:
                span.set_status(Status(StatusCode.ERROR))
            span.end(until)
            started = until
        whole.end(ended)
        return trace.format_trace_id(whole.get_span_context().trace_id)

    def _llm_attributes(self, answer: DecideResponse) -> dict[str, Any]:
        attributes: dict[str, Any] = {
            "gen_ai.operation.name": "chat",
            "gen_ai.provider.name": self._vendor,
            **self._server,
        }
        if answer.model:
            attributes |= {"gen_ai.request.model": answer.model, "gen_ai.response.model": answer.model}
        if answer.tokens.server_prompt is not None:
            attributes["gen_ai.usage.input_tokens"] = answer.tokens.server_prompt
            attributes["gen_ai.usage.output_tokens"] = answer.tokens.completion or 0
        if answer.reason in LLM_FAILURES:
            attributes["error.type"] = answer.reason
        return attributes

    def close(self) -> None:
        """Send the queued spans."""
        if self.provider is not None:
            self.provider.shutdown()


class Traced:
    """Pure ASGI middleware: the client's trace is the parent of the spans of its request."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        from opentelemetry import context
        from opentelemetry.propagate import extract

        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        token = context.attach(extract(headers))
        try:
            await self.app(scope, receive, send)
        finally:
            context.detach(token)


def _address(url: str | None) -> dict[str, Any]:
    """The address of a single LLM server; of several, the called one is unknown."""
    if url is None or "," in url:
        return {}
    # Already imported: the settings check the URL with it.
    import httpx

    parsed = httpx.URL(url)
    return {"server.address": parsed.host, "server.port": parsed.port or (443 if parsed.scheme == "https" else 80)}


def _attributes(answer: DecideResponse) -> dict[str, Any]:
    names = ("decision_id", "mission_id", "uav_id", "step", "source", "sensor_id", "velocity", "reason")
    found = {f"aicvds.{name}": getattr(answer, name) for name in names}
    return {name: value for name, value in found.items() if value is not None}


def _ns(milliseconds: float) -> int:
    return int(milliseconds * 1e6)
