"""Prometheus, its alerts and the dashboard, with Debian's real Prometheus: every expression returns data.

Time runs sixty times as fast here: what is a minute in docker/alerts.yml is a second, so that a flight of a minute is
an hour of what the alerts look at.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from grafana_foundation_sdk.cog import plugins
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard

from tests.support.edge_stub import free_port
from tests.support.places import ROOT
from tests.support.processes import serving_edge, started

pytestmark = pytest.mark.needs("prometheus")

DOCKER = ROOT / "docker"
ALERTS = DOCKER / "alerts.yml"
BOARD: dict[str, Any] = json.loads((DOCKER / "grafana" / "dashboards" / "aicvds.json").read_text())
# What an alert must be, so that its number can be asked for whether it fires or not.
COMPARED = re.compile(r"(?P<number>aicvds:\w+:\w+) (>|<) [\d.]+")
FAST = {"1h": "60s", "10m": "10s", "5m": "5s"}


def binary(name: str) -> str:
    """Where Debian's package `prometheus` put it; without it the test fails."""
    path = shutil.which(name)
    if path is None:
        pytest.fail(f"{name} is missing: apt-get install --no-install-recommends prometheus")
    return path


def promtool(*args: str) -> str:
    ended = subprocess.run([binary("promtool"), *args], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def rules() -> list[dict[str, str]]:
    return [rule for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]]


def found(node: Any, key: str) -> Iterator[Any]:
    """Every value of that key, however deep."""
    if isinstance(node, dict):
        for name, value in node.items():
            if name == key:
                yield value
            yield from found(value, key)
    elif isinstance(node, list):
        for item in node:
            yield from found(item, key)


def test_promtool_accepts_the_configuration_and_the_rules() -> None:
    promtool("check", "config", str(DOCKER / "prometheus.yml"))
    assert f"{len(rules())} rules found" in promtool("check", "rules", str(ALERTS))


def test_every_alert_fires_when_it_should_and_only_then() -> None:
    cases = Path(__file__).with_name("alerts_test.yml")
    promtool("test", "rules", str(cases))
    tried = [case for test in yaml.safe_load(cases.read_text())["tests"] for case in test.get("alert_rule_test", ())]
    alerts = {rule["alert"] for rule in rules() if "alert" in rule}
    assert {case["alertname"] for case in tried if case["exp_alerts"]} == alerts
    assert {case["alertname"] for case in tried if not case["exp_alerts"]} == alerts


def calculated(folder: Path, world: dict[str, str], expected: dict[str, tuple[str, float] | None]) -> bool:
    """Whether each expression has this one value, or none, after a minute of these series of 5 s."""
    cases = [
        {
            "expr": expression,
            "eval_time": "1m",
            "exp_samples": [{"labels": value[0], "value": value[1]}] if value else [],
        }
        for expression, value in expected.items()
    ]
    series = [{"series": name, "values": values} for name, values in world.items()]
    test = {"interval": "5s", "input_series": series, "promql_expr_test": cases}
    (folder / "tests.yml").write_text(yaml.safe_dump({"rule_files": [], "tests": [test]}))
    return "SUCCESS" in promtool("test", "rules", str(folder / "tests.yml"))


def test_every_alert_that_the_guide_adds_has_a_value_when_it_should_and_only_then(tmp_path: Path) -> None:
    """The same table of expressions, once of an edge without an LLM in a bad world and once of one without faults."""
    guide = (ROOT / "docs" / "reference" / "metrics.md").read_text(encoding="utf-8")
    expressions = re.findall(r"^\| [^`|]+ \| `(.+)` \|$", guide.partition("Further useful alerts")[2], re.MULTILINE)
    decided = 'aicvds_decisions_total{{source="{}", reason="{}"}}'
    bad = {
        decided.format("policy", "llm_error"): "0+9x100",
        "aicvds_costs_clipped_total": "0+1x100",
        'aicvds_link_excess_db_bucket{le="5"}': "0x100",
        'aicvds_link_excess_db_bucket{le="10"}': "0+9x100",
        'aicvds_link_excess_db_bucket{le="+Inf"}': "0+9x100",
        "aicvds_radio_failures_total": "0+1x100",
    }
    good = {
        decided.format("guided", "none"): "0+9x100",
        decided.format("policy", "llm_error"): "0+8x100",
        "aicvds_costs_clipped_total": "3x100",
        "aicvds_radio_failures_total": "3x100",
    }
    plain = [one.replace(r"\|", "|") for one in expressions]
    assert calculated(tmp_path, bad, {f"count({one})": ("{}", 1) for one in plain})
    assert calculated(tmp_path, good, {f"count({one})": None for one in plain})
    assert len(expressions) == 4


def test_every_alert_compares_a_number_that_is_recorded() -> None:
    recorded = {rule["record"] for rule in rules() if "record" in rule}
    compared = [COMPARED.fullmatch(rule["expr"]) for rule in rules() if "alert" in rule]
    assert {match["number"] for match in compared if match} == recorded
    assert all(compared)


def test_the_dashboard_explains_itself() -> None:
    panels = [panel for panel in BOARD["panels"] if panel["type"] != "row"]
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(BOARD["panels"])
    assert len({panel["title"] for panel in panels}) == len(panels)
    for panel in panels:
        assert panel["description"] and panel["targets"], panel["title"]
        assert panel["fieldConfig"]["defaults"]["unit"], panel["title"]
        assert all(target["expr"] and target["legendFormat"] for target in panel["targets"]), panel["title"]
    # The data source is whatever the reader chooses, and at first the one that is provisioned.
    sources = {source["uid"] for source in found(BOARD, "datasource") if isinstance(source, dict)}
    assert sources == {"${datasource}", "-- Grafana --"}
    provisioned = yaml.safe_load((DOCKER / "grafana/provisioning/datasources/prometheus.yml").read_text())
    [chosen] = [v for v in BOARD["templating"]["list"] if v["name"] == "datasource"]
    assert chosen["current"]["value"] == provisioned["datasources"][0]["uid"]


def test_grafana_knows_every_field_of_the_dashboard() -> None:
    """What its own typed models do not know of, they drop; what is missing, they add."""
    plugins.register_default_plugins()
    kept = json.loads(JSONEncoder().encode(Dashboard.from_json(BOARD)))
    assert not list(dropped(BOARD, kept, "dashboard"))


def dropped(node: Any, kept: Any, path: str) -> Iterator[str]:
    """Paths of what is in the one and not in the other."""
    if isinstance(node, dict) and isinstance(kept, dict):
        for name, value in node.items():
            yield from dropped(value, kept.get(name), f"{path}.{name}")
    elif isinstance(node, list) and isinstance(kept, list) and len(node) == len(kept):
        for index, (one, other) in enumerate(zip(node, kept, strict=True)):
            yield from dropped(one, other, f"{path}[{index}]")
    elif node != kept:
        yield path


def test_the_dashboard_shows_every_alerts_number_with_its_threshold() -> None:
    for rule in (rule for rule in rules() if "alert" in rule):
        number, _, limit = rule["expr"].split()
        panels = [p for p in BOARD["panels"] if any(number in target["expr"] for target in p.get("targets", ()))]
        assert panels, rule["alert"]
        for panel in panels:
            steps = [step["value"] for step in panel["fieldConfig"]["defaults"]["thresholds"]["steps"]]
            # Of a count the first that is too many; a line without a threshold is drawn where none of it is well.
            assert float(limit) in steps or float(limit) == 0, panel["title"]


def asked_by_the_dashboard() -> list[str]:
    """Every expression, and for each variable the series that it takes its values from."""
    variables = [v["query"]["query"] for v in BOARD["templating"]["list"] if v["type"] == "query"]
    labels = [re.findall(r"label_values\((.+), \w+\)", text)[0] for text in variables]
    return [*found(BOARD, "expr"), *labels]


def fast(text: str) -> str:
    """The text with durations of minutes as seconds."""
    reported = re.sub(r"(?<=\[)\w+(?=\])|(?<=offset )\w+", lambda match: FAST[match[0]], text)
    return re.sub(r"for: .*", "for: 1s", reported)


def filled_in(expression: str) -> str:
    """As Grafana would ask, with its variables' values."""
    for name, value in {"__rate_interval": "10s", "__range": "60s", "instance": ".*", "simulator": ".*"}.items():
        expression = expression.replace(f"${name}", value)
    assert "$" not in expression, f"a variable that this test does not know: {expression}"
    return expression


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ("_x3 30x20", 30),
        # Decisions before the time shown do not count.
        ("30x3 32x20", 2),
        # A flight has ended.
        ("_x3 30x3 stale", 30),
    ],
)
def test_a_burst_of_decisions_is_counted(values: str, count: int, tmp_path: Path) -> None:
    """A series begins with the first decisions of its source and reason: nothing comes before it."""
    expressions = [filled_in(one) for one in found(BOARD, "expr") if "__range" in one]
    metrics = {re.findall(r"aicvds_\w+", one)[0] for one in expressions}
    labels = '{source="policy", reason="llm_error"}'
    series = {metric + '{instance="e", source="policy", reason="llm_error"}': values for metric in metrics}
    assert calculated(tmp_path, series, {f"round({one})": (labels, count) for one in expressions})
    assert len(metrics) == len(expressions) == 2


@contextmanager
def scraping(edge: str, simulator: int, folder: Path) -> Iterator[httpx.Client]:
    """A real Prometheus with the real configuration, but for the targets and the pace; yields a client of it."""
    config = (DOCKER / "prometheus.yml").read_text()
    for ours, here in {
        "edge:8000": edge.removeprefix("http://"),
        "simulator:8001": f"127.0.0.1:{simulator}",
        ": 5s": ": 500ms",
        ": 4s": ": 400ms",
    }.items():
        assert ours in config
        config = config.replace(ours, here)
    (folder / "prometheus.yml").write_text(config)
    (folder / "alerts.yml").write_text(fast(ALERTS.read_text()))
    port = free_port()
    command = [binary("prometheus"), f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}/data"]
    with (folder / "prometheus.log").open("w") as log:
        process = subprocess.Popen(
            [*command, f"--web.listen-address=127.0.0.1:{port}"], stdout=log, stderr=subprocess.STDOUT
        )
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30) as client:
            ends = time.monotonic() + 60
            while not ready(client):
                assert time.monotonic() < ends and process.poll() is None, (folder / "prometheus.log").read_text()
                time.sleep(0.1)
            yield client
    finally:
        process.kill()
        process.wait()


def ready(prometheus: httpx.Client) -> bool:
    """Whether it has started: before, it takes no connections, and then answers 503."""
    try:
        return prometheus.get("/-/ready").status_code == 200
    except httpx.TransportError:
        return False


def has_data(prometheus: httpx.Client, expression: str) -> bool:
    """Whether there is a number, and not only one that is none."""
    answer = prometheus.post("/api/v1/query", data={"query": expression})
    assert answer.status_code == 200, f"{expression}: {answer.text}"
    return any(math.isfinite(float(sample["value"][1])) for sample in answer.json()["data"]["result"])


def lacking(prometheus: httpx.Client, expressions: set[str], seconds: float) -> set[str]:
    """Those that have returned no data within the time."""
    ends = time.monotonic() + seconds
    while expressions and time.monotonic() < ends:
        expressions = {expression for expression in expressions if not has_data(prometheus, expression)}
        time.sleep(0.5)
    return expressions


@pytest.mark.long
@pytest.mark.timeout(300)
def test_every_expression_returns_data_while_a_mission_flies(tmp_path: Path) -> None:
    port = free_port()
    # On a busy machine the LLM takes its time, and without its answers half of the expressions have no data.
    settings = {"AICVDS_STORE": str(tmp_path / "missions.db"), "AICVDS_DEADLINE_MS": "30000"}
    with ExitStack() as stack:
        url, _ = stack.enter_context(serving_edge(**settings))
        prometheus = stack.enter_context(scraping(url, port, tmp_path))
        flight = ("--edge", url, "--steps", "2000", "--out", str(tmp_path / "run"), "--metrics-port", str(port))
        stack.enter_context(started("simulate", *flight, "--deadline-ms", "30000"))
        wanted = {filled_in(expression) for expression in asked_by_the_dashboard()}
        numbers = {match["number"] for rule in rules() if (match := COMPARED.fullmatch(rule["expr"]))}
        assert len(wanted) > 40 and len(numbers) == sum("alert" in rule for rule in rules())
        assert lacking(prometheus, wanted | numbers, 200) == set()
        assert lacking(prometheus, {"aicvds_no_such_thing"}, 1)
        # And the rules are evaluated as they are written, without an error.
        groups = prometheus.get("/api/v1/rules").json()["data"]["groups"]
        evaluated = [rule for group in groups for rule in group["rules"]]
        assert [rule["health"] for rule in evaluated] == ["ok"] * len(rules())
        targets = prometheus.get("/api/v1/targets").json()["data"]["activeTargets"]
        assert {(target["labels"]["job"], target["health"]) for target in targets} == {
            ("edge", "up"),
            ("simulator", "up"),
            # Its container runs in the profile mqtt alone.
            ("uplinks", "down"),
        }
