"""OpenTelemetry traces (extra ``otel``): one span a decision, in it one a stage, the LLM's as a client span.

Set the standard ``OTEL_EXPORTER_OTLP_ENDPOINT``, and spans go there; without it, or without the extra, there are none.
A ``traceparent`` that the request carries is the decision's parent. The LLM's span follows the semantic conventions for
generative AI. Prompts and answers are not in it.
"""

from __future__ import annotations

import logging
import os
import time
from typing import TYPE_CHECKING, Any

from starlette.types import ASGIApp, Receive, Scope, Send

from service.config.settings import Settings
from shared.reasons import LLM_FAILURES
from shared.wire import DecideResponse

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

log = logging.getLogger(__name__)

_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")


def provider_from_environment(version: str) -> TracerProvider | None:
    """A provider that exports over OTLP, where the environment names an endpoint; None without one or the extra."""
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
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return provider


class Traces:
    """Records decisions; without a provider, nothing."""

    def __init__(self, provider: TracerProvider | None, settings: Settings) -> None:
        self.provider = provider
        self._tracer = None if provider is None else provider.get_tracer("aic_vds.edge")
        self._server = _where(settings.llm_url)
        self._vendor = "openai" if settings.llm_url else "llama.cpp"

    def decided(self, answer: DecideResponse) -> None:
        """The spans of a decision just answered, from its stages' times, which follow each other.

        Those of a batch all end now, as their answers do.
        """
        if self._tracer is None:
            return
        from opentelemetry import trace
        from opentelemetry.trace import SpanKind, Status, StatusCode

        ended = time.time_ns()
        begun = ended - _ns(answer.latency_ms["total"])
        whole = self._tracer.start_span("decide", kind=SpanKind.SERVER, start_time=begun, attributes=_about(answer))
        inside = trace.set_span_in_context(whole)
        for stage, milliseconds in answer.latency_ms.items():
            if stage == "total":
                continue
            until = begun + _ns(milliseconds)
            if stage == "llm":
                attributes = self._of_llm(answer)
                name, kind = f"chat {answer.model or 'unknown'}", SpanKind.CLIENT
            else:
                attributes, name, kind = {}, stage, SpanKind.INTERNAL
            span = self._tracer.start_span(name, inside, kind, attributes, start_time=begun)
            if "error.type" in attributes:
                span.set_status(Status(StatusCode.ERROR))
            span.end(until)
            begun = until
        whole.end(ended)

    def _of_llm(self, answer: DecideResponse) -> dict[str, Any]:
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
        """Send what is waiting."""
        if self.provider is not None:
            self.provider.shutdown()


class Traced:
    """Pure ASGI middleware: the caller's trace is the parent of what is recorded while it is served."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        from opentelemetry import context
        from opentelemetry.propagate import extract

        told = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        token = context.attach(extract(told))
        try:
            await self.app(scope, receive, send)
        finally:
            context.detach(token)


def _where(url: str | None) -> dict[str, Any]:
    """Where the only LLM server is; of several nobody knows which was asked."""
    if url is None or "," in url:
        return {}
    # The settings have imported it where they name a server.
    import httpx

    parsed = httpx.URL(url)
    return {"server.address": parsed.host, "server.port": parsed.port or (443 if parsed.scheme == "https" else 80)}


def _about(answer: DecideResponse) -> dict[str, Any]:
    told = {
        "aicvds.decision_id": answer.decision_id,
        "aicvds.mission_id": answer.mission_id,
        "aicvds.uav_id": answer.uav_id,
        "aicvds.step": answer.step,
        "aicvds.source": answer.source,
        "aicvds.sensor_id": answer.sensor_id,
        "aicvds.velocity": answer.velocity,
    }
    return told if answer.reason is None else {**told, "aicvds.reason": answer.reason}


def _ns(milliseconds: float) -> int:
    return int(milliseconds * 1e6)
