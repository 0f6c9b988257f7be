"""Several processes' metrics as one text."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as openmetrics
from prometheus_client.parser import text_string_to_metric_families

from service.cluster.exchange import gathered
from service.observability.metrics import Metrics


def _exposed(count: int) -> str:
    registry = CollectorRegistry()
    Gauge("plain", "A gauge, {braces} and spaces", registry=registry).set(count)
    Counter("asked", "A counter", ["why"], registry=registry).labels('a "b" {c} \\ d').inc(count)
    Histogram("took", "A histogram", registry=registry, buckets=(1, 2)).observe(count)
    return generate_latest(registry).decode()


def test_every_sample_has_its_process() -> None:
    texts = {"0": _exposed(1), "2": _exposed(5)}
    merged = list(text_string_to_metric_families(gathered(texts)))
    assert len({family.name for family in merged}) == len(merged)
    alone = {
        (sample.name, frozenset({**sample.labels, "process": process}.items())): sample.value
        for process, text in texts.items()
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    found = {(s.name, frozenset(s.labels.items())): s.value for family in merged for s in family.samples}
    assert found == alone
    assert all(family.documentation for family in merged)


def test_the_edges_own_metrics_are_gathered() -> None:
    texts = {slot: generate_latest(Metrics().registry).decode() for slot in "01"}
    families = {family.name: family for family in text_string_to_metric_families(gathered(texts))}
    assert {s.labels["process"] for s in families["aicvds_missions"].samples} == {"0", "1"}
    assert families["aicvds_link_excess_db"].type == "histogram"
    assert not gathered({})


def test_openmetrics_of_several_edges_is_openmetrics() -> None:
    texts = {slot: Metrics().exposed("application/openmetrics-text; version=1.0.0")[0].decode() for slot in "01"}
    families = list(openmetrics(gathered(texts)))  # type: ignore[no-untyped-call]
    assert {s.labels["process"] for family in families for s in family.samples} == {"0", "1"}
