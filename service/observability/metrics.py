"""Every Prometheus metric of the edge. No label names a mission, UAV or sensor: there are too many of them."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import version

import numpy as np
from numpy.typing import ArrayLike
from prometheus_client import CollectorRegistry, disable_created_metrics, generate_latest
from prometheus_client.core import Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics import Counter, Gauge, Histogram, Info, Summary
from prometheus_client.platform_collector import PlatformCollector
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from shared.belief.fleet_belief import Measured
from shared.wire.readings import ReadingResult
from shared.wire.schemas import DecideResponse

_DECISION_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2, 3, 5, 10, 30, 60)
_OVERHEAD_BUCKETS = (0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1)
_SHARE_BUCKETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1)
_EXCESS_BUCKETS_DB = (-20, -10, -6, -3, -1, 0, 1, 3, 6, 10, 15, 20, 30, 40)
_STATUSES = ("loading", "ready", "degraded", "unavailable", "off")


class ArrayHistogram(Collector):
    """A histogram without labels; prometheus_client's own takes one value a call.

    Args:
        buckets: upper bounds, ascending; the last bucket is without a bound.
    """

    def __init__(self, name: str, documentation: str, registry: CollectorRegistry, buckets: Sequence[float]) -> None:
        self._name, self._documentation = name, documentation
        self._bounds = np.array(buckets, dtype=np.float64)
        self._labels = [*(str(float(bound)) for bound in buckets), "+Inf"]
        self._counts = np.zeros(len(self._labels), dtype=np.int64)
        self._sum = 0.0
        registry.register(self)

    def observe(self, values: ArrayLike) -> None:
        """Count values ``(n,)``; a value that equals a bound is in the bound's bucket."""
        taken = np.asarray(values, dtype=np.float64)
        self._counts += np.bincount(self._bounds.searchsorted(taken), minlength=len(self._counts))
        self._sum += float(np.add.reduce(taken))

    def collect(self) -> Iterable[Metric]:
        """The histogram as it is now."""
        # HistogramMetricFamily has neither count nor sum where a bound is negative.
        metric = Metric(self._name, self._documentation, "histogram")
        for label, below in zip(self._labels, np.cumsum(self._counts).tolist(), strict=True):
            metric.add_sample(f"{self._name}_bucket", {"le": label}, below)
        metric.add_sample(f"{self._name}_count", {}, int(self._counts.sum()))
        metric.add_sample(f"{self._name}_sum", {}, self._sum)
        yield metric


class _AsOpenMetrics(Collector):
    """A registry's metrics, as OpenMetrics allows them: a histogram with a bound below 0 has neither sum nor count."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._registry = registry

    def collect(self) -> Iterable[Metric]:
        for metric in self._registry.collect():
            if any(sample.labels.get("le", "").startswith("-") for sample in metric.samples):
                metric.samples = [sample for sample in metric.samples if "le" in sample.labels]
            yield metric


class Metrics:
    """The metrics of one edge, in their own registry."""

    def __init__(self) -> None:
        # A series for each series, of no use to Prometheus.
        disable_created_metrics()  # type: ignore[no-untyped-call]
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        r = self.registry
        self._kinds = partial(Counter, registry=r), partial(Gauge, registry=r), partial(Histogram, registry=r)
        counter, gauge, histogram = self._kinds
        Info("aicvds_build", "The version of this edge", registry=r).info({"version": version("aic-vds")})
        self.decisions = counter("aicvds_decisions", "Decisions answered", ["source", "reason"])
        self.decision_seconds = histogram(
            "aicvds_decision_seconds", "Times by stage", ["stage"], buckets=_DECISION_BUCKETS
        )
        self.overhead_seconds = histogram(
            "aicvds_overhead_seconds", "All stages but the LLM", buckets=_OVERHEAD_BUCKETS
        )
        self._add_llm()
        self.tokens_saved = counter("aicvds_tokens_saved", "Tokens saved by attention, masks and short rows")
        self._add_outcomes()
        self.deadline_missed = counter("aicvds_deadline_missed", "Decisions answered past their deadline")
        self.tasks = gauge("aicvds_tasks", "Tasks of the event loop")
        self.alarms = gauge("aicvds_alarms", "UAVs and sensors of which a mission's page shows an alarm", ["kind"])
        self.missions = gauge("aicvds_missions", "Missions in memory or in the store")
        self.store_seconds = histogram("aicvds_store_seconds", "Time of a commit", buckets=_OVERHEAD_BUCKETS)
        self.store_failures = counter(
            "aicvds_store_failures", "Commits and renewals of leases that failed; they are tried again"
        )
        self.leases = gauge("aicvds_leases", "Missions that this edge owns in a shared store")
        self.leases_taken_over = counter("aicvds_leases_taken_over", "Missions of other edges or starts taken over")
        self.leases_lost = counter("aicvds_leases_lost", "Missions that another edge has taken over")
        # Looking up a child by its labels takes as long as counting; there are few children.
        self._decisions, self._seconds = cache(self.decisions.labels), cache(self.decision_seconds.labels)
        self._tokens = cache(self.llm_tokens.labels)

    def _add_llm(self) -> None:
        counter, gauge, histogram = self._kinds
        self.llm_requests = counter("aicvds_llm_requests", "Queries to the LLM by outcome", ["outcome"])
        self.llm_breaker_opened = counter("aicvds_llm_breaker_opened", "Times that an LLM server's breaker opened")
        self.llm_breaker_open = gauge("aicvds_llm_breaker_open", "LLM servers whose circuit breaker is open now")
        self.llm_servers = gauge("aicvds_llm_servers", "LLM servers by state", ["status"])
        self.llm_tokens = counter("aicvds_llm_tokens", "Tokens that the LLM server reported", ["kind"])
        self.llm_trust = histogram("aicvds_llm_trust", "The LLM's weight in mode guided", buckets=_SHARE_BUCKETS)
        self.evaluator_timeouts = counter(
            "aicvds_critic_timeouts", "Decisions whose rollout evaluator was late or failed"
        )
        self.keys_lost = gauge(
            "aicvds_keys_lost", "Whether the file of API keys is unreadable: the previous keys apply"
        )

    def _add_outcomes(self) -> None:
        """The metrics of outcomes and reports."""
        counter, gauge, histogram = self._kinds
        self.feedback = counter("aicvds_feedback", "Outcomes received", ["result"])
        self.costs_clipped = counter("aicvds_costs_clipped", "Outcomes with a cost above the largest of a step")
        self.learner_loss = gauge("aicvds_learner_loss", "Latest value-regression loss of any mission")
        r, every = self.registry, "Value-regression loss of every update"
        self.learner_update_loss = Summary("aicvds_learner_update_loss", every, registry=r)
        risk = "At each decision, the share of sensors that are expected to overflow before their next visit"
        self.overflow_risk = histogram("aicvds_overflow_risk", risk, buckets=_SHARE_BUCKETS)
        excess = "Path loss measured by beacons minus the formula's, dB"
        self.link_excess_db = ArrayHistogram("aicvds_link_excess_db", excess, registry=r, buckets=_EXCESS_BUCKETS_DB)
        self.radio_failures = counter("aicvds_radio_failures", "Transmissions that failed over a good link")
        self.readings = counter("aicvds_readings", "Sensors' own readings by result", ["result"])

    def record_readings(self, results: Collection[ReadingResult]) -> None:
        """Count sensors' own readings by result."""
        for result in results:
            self.readings.labels(result).inc()

    def record_llm(self, statuses: Mapping[str, int], breakers_open: int) -> None:
        """Set the states of the LLM servers.

        Args:
            statuses: number of servers by state.
            breakers_open: number of open circuit breakers.
        """
        for status in _STATUSES:
            self.llm_servers.labels(status).set(statuses.get(status, 0))
        self.llm_breaker_open.set(breakers_open)

    def exposed(self, accepted: str) -> tuple[bytes, str]:
        """All metrics and their content type: OpenMetrics where an Accept header names it, else Prometheus's text."""
        if "application/openmetrics-text" not in accepted:
            return generate_latest(self.registry), "text/plain; version=0.0.4; charset=utf-8"
        encode, content_type = choose_encoder(accepted)
        return encode(_AsOpenMetrics(self.registry)), content_type

    def record_measured(self, measured: Measured) -> None:
        """Count the measurements of one report."""
        self.link_excess_db.observe(measured.excess_db)
        self.radio_failures.inc(measured.radio_failed)

    def record_decision(self, decision: DecideResponse, trace_id: str | None) -> None:
        """Count one answered decision: source, stages, overhead, tokens, lateness; its trace is the times' exemplar."""
        exemplar = None if trace_id is None else {"trace_id": trace_id}
        self._decisions(decision.source, decision.reason or "none").inc()
        for stage, milliseconds in decision.latency_ms.items():
            self._seconds(stage).observe(milliseconds / 1e3, exemplar)
        total = decision.latency_ms["total"]
        self.overhead_seconds.observe((total - decision.latency_ms.get("llm", 0.0)) / 1e3)
        if total > decision.deadline_ms:
            self.deadline_missed.inc()
        tokens = decision.tokens
        if tokens.server_prompt is None:
            return
        self.tokens_saved.inc(tokens.saved)
        self._tokens("prompt").inc(tokens.server_prompt)
        self._tokens("cached").inc(tokens.cached or 0)
        self._tokens("completion").inc(tokens.completion or 0)
