"""The Helm chart: Helm accepts it, Kubernetes' schemas accept its objects, and the edges accept their settings."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from starlette.responses import Response

from service.api.authentication import KnownHosts
from service.config.settings import Settings
from tests.support.chart_tools import CHART, helm, run, validator
from tests.support.places import ROOT

pytestmark = pytest.mark.long

SECRET = {"AICVDS_STORE": "postgresql://aicvds:secret@db/aicvds", "AICVDS_LLM_API_KEY": "secret"}
# Each turns on what the one before leaves out.
SMALL: dict[str, Any] = {
    "image": {"tag": "1.2.3"},
    "settings": {"AICVDS_ANONYMOUS": True, "AICVDS_MAX_BODY_BYTES": 2_000_000, "AICVDS_LEARNING_RATE": 5e-4},
    "metrics": {"scrape": "off"},
    "disruptionBudget": {"enabled": False},
    "networkPolicy": {"enabled": False},
    "drainSeconds": 0,
}
LARGE: dict[str, Any] = {
    "image": {"tag": "1.2.3", "pullSecrets": ["registry"]},
    "replicas": 20,
    "settings": {
        "AICVDS_LLM_URL": "http://vllm-0.vllm:8000/v1,http://vllm-1.vllm:8000/v1",
        "AICVDS_LLM_ORDER": "mission",
        "AICVDS_LLM_SLOTS": 8,
        "OTEL_EXPORTER_OTLP_ENDPOINT": "http://collector:4318",
        "SSL_CERT_FILE": "/ca/ca.crt",
    },
    "extraVolumes": [{"name": "ca", "configMap": {"name": "ca"}}],
    "extraVolumeMounts": [{"name": "ca", "mountPath": "/ca", "readOnly": True}],
    "secretSettings": {"AICVDS_LLM_API_KEY": {"name": "aicvds", "key": "llm-api-key"}},
    "keys": {"secretName": "aicvds-keys"},
    "advertiseUrl": "https://$(POD_NAME).edges.example.org",
    "service": {"type": "LoadBalancer", "port": 80, "annotations": {"a": "b"}},
    "metrics": {
        "scrape": "serviceMonitor",
        "labels": {"release": "prometheus"},
        "keySecret": {"name": "aicvds", "key": "metrics-key"},
    },
    "disruptionBudget": {"maxUnavailable": "10%"},
    "networkPolicy": {
        "from": [{"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "ingress"}}}],
        "egressPorts": [5432, 8000],
    },
    "podAnnotations": {"a": "b"},
    "podLabels": {"c": "d"},
    "nodeSelector": {"kubernetes.io/os": "linux"},
    "tolerations": [{"key": "edge", "operator": "Exists"}],
    "affinity": {"podAntiAffinity": {}},
    "priorityClassName": "high",
}

Objects = dict[tuple[str, str], dict[str, Any]]


@pytest.fixture(scope="module", autouse=True)
def program() -> None:
    if helm() is None:
        assert not os.environ.get("TESTS_COMPLETE")
        pytest.skip("no Helm for this machine")


def rendered(folder: Path, values: dict[str, Any]) -> Objects:
    """The chart's objects, by kind and name."""
    (folder / "values.yaml").write_text(yaml.safe_dump(values))
    done = run("template", "fleet", str(CHART), "--namespace", "uavs", "--values", str(folder / "values.yaml"))
    assert done.returncode == 0, done.stderr
    objects = [one for one in yaml.safe_load_all(done.stdout) if one is not None]
    found = {(one["kind"], one["metadata"]["name"]): one for one in objects}
    assert len(found) == len(objects)
    return found


@pytest.fixture(scope="module", params=[SMALL, LARGE], ids=["small", "large"])
def objects(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Objects:
    return rendered(tmp_path_factory.mktemp("chart"), request.param)


def environment(objects: Objects) -> dict[str, str]:
    """What the edges' container sees, with what a Secret would have."""
    (edge,) = objects["StatefulSet", "fleet-aicvds"]["spec"]["template"]["spec"]["containers"]
    found: dict[str, str] = {}
    for source in edge["envFrom"]:
        found |= objects["ConfigMap", source["configMapRef"]["name"]]["data"]
    for variable in edge["env"]:
        if "value" in variable:
            found[variable["name"]] = variable["value"].replace("$(POD_NAME)", "fleet-aicvds-0")
        elif "secretKeyRef" in variable["valueFrom"]:
            found[variable["name"]] = SECRET[variable["name"]]
    return found


def test_helm_finds_no_fault() -> None:
    done = run("lint", "--strict", str(CHART))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 chart(s) failed" in done.stdout


def test_an_edge_sees_every_volume_of_its_pod(objects: Objects) -> None:
    pod = objects["StatefulSet", "fleet-aicvds"]["spec"]["template"]["spec"]
    mounted = {mount["name"]: mount["mountPath"] for mount in pod["containers"][0]["volumeMounts"]}
    assert mounted.keys() == {volume["name"] for volume in pod["volumes"]}
    assert len(mounted) == len(pod["volumes"]) == (1 if "keys" not in mounted else 3)
    if "SSL_CERT_FILE" in (given := environment(objects)):
        assert given["SSL_CERT_FILE"].startswith(mounted["ca"])


def test_helm_has_the_options_of_an_upgrade() -> None:
    guide = (ROOT / "docs" / "guides" / "upgrading.md").read_text(encoding="utf-8")
    asked = set(re.findall(r"--[a-z][a-z-]+", guide.partition("With Helm: ")[2]))
    assert asked == {"--reuse-values", "--set", "--reset-then-reuse-values", "--set-string"}
    assert asked <= set(re.findall(r"--[a-z][a-z-]+", run("upgrade", "--help").stdout))


def test_kubernetes_knows_every_field(objects: Objects) -> None:
    known = 0
    for (kind, name), one in objects.items():
        if (schema := validator(one["apiVersion"], kind)) is not None:
            assert [f"{kind} {name}: {error.message}" for error in schema.iter_errors(one)] == []
            known += 1
        else:
            # The Prometheus operator's, whose schema no package has.
            assert kind == "ServiceMonitor"
    assert known >= 4


def test_a_misspelled_field_is_a_fault() -> None:
    schema = validator("apps/v1", "StatefulSet")
    assert schema is not None
    assert not schema.is_valid({"apiVersion": "apps/v1", "kind": "StatefulSet", "spec": {"replica": 1}})


def test_an_edge_accepts_its_settings(objects: Objects, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("AICVDS_")]:
        monkeypatch.delenv(name)
    given = {name: value for name, value in environment(objects).items() if name.startswith("AICVDS_")}
    assert given.keys() <= {f"AICVDS_{name.upper()}" for name in Settings.model_fields}
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    settings = Settings()
    assert settings.store == SECRET["AICVDS_STORE"]
    assert settings.advertise_url is not None and "fleet-aicvds-0." in settings.advertise_url


def test_numbers_and_switches_arrive_as_the_edge_writes_them(tmp_path: Path) -> None:
    given = environment(rendered(tmp_path, SMALL))
    assert {name: given[name] for name in SMALL["settings"]} == {
        "AICVDS_ANONYMOUS": "on",
        "AICVDS_MAX_BODY_BYTES": "2000000",
        "AICVDS_LEARNING_RATE": "0.0005",
    }


@pytest.mark.parametrize(("given", "elsewhere"), [("fleet.example.org", 403), ("", 204), ("*", 204)])
async def test_without_keys_an_edge_answers_to_its_services_names(tmp_path: Path, given: str, elsewhere: int) -> None:
    values = SMALL | {"settings": {"AICVDS_ANONYMOUS": "on", "AICVDS_HOSTS": given}}
    hosts = environment(rendered(tmp_path, values))["AICVDS_HOSTS"]
    edge = KnownHosts(Response(status_code=204), Settings(hosts=hosts, anonymous="on", store="none"))
    names = ["fleet.example.org", "fleet-aicvds:8000", *(f"fleet-aicvds.uavs{end}" for end in ("", ".svc"))]
    async with httpx.AsyncClient(transport=httpx.ASGITransport(edge)) as client:
        found = [
            (await client.get(f"http://{name}/")).status_code
            for name in (*names, "fleet-aicvds.uavs.svc.cluster.local", "elsewhere.example.org")
        ]
    assert found == [204] * 5 + [elsewhere]


def test_opentelemetrys_switches_are_its_own_words(tmp_path: Path) -> None:
    settings = {"AICVDS_ANONYMOUS": True, "OTEL_SDK_DISABLED": True}
    assert environment(rendered(tmp_path, SMALL | {"settings": settings}))["OTEL_SDK_DISABLED"] == "true"


@pytest.mark.parametrize("tag", ["1.2.3@sha256:" + "0123456789abcdef" * 4, "v" * 100])
def test_whatever_the_tag_the_labels_are_labels(tmp_path: Path, tag: str) -> None:
    for one in rendered(tmp_path, SMALL | {"image": {"tag": tag}}).values():
        for value in one["metadata"]["labels"].values():
            assert re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,61}[A-Za-z0-9])?", value)


def test_headers_with_a_key_come_from_a_secret_and_an_upgrade_may_end_all_edges(tmp_path: Path) -> None:
    secret = {"AICVDS_LLM_EXTRA_HEADERS": {"name": "aicvds", "key": "headers"}}
    edges = rendered(tmp_path, LARGE | {"secretSettings": secret, "replicas": 0})["StatefulSet", "fleet-aicvds"]
    assert edges["spec"]["replicas"] == 0
    [edge] = edges["spec"]["template"]["spec"]["containers"]
    [found] = [one for one in edge["env"] if one["name"] == "AICVDS_LLM_EXTRA_HEADERS"]
    assert found["valueFrom"]["secretKeyRef"] == {"name": "aicvds", "key": "headers"}


def test_the_schema_lists_every_setting() -> None:
    schema = json.loads((CHART / "values.schema.json").read_text())
    listed = schema["definitions"]["setting"]["enum"]
    # These have values of their own, are in Secrets, or in the image's command.
    elsewhere = {"STORE", "LLM_API_KEY", "KEYS", "ADVERTISE_URL", "HOST", "PORT"}
    assert len(listed) == len(set(listed))
    assert set(listed) == {f"AICVDS_{name.upper()}" for name in Settings.model_fields if name.upper() not in elsewhere}


def test_an_edge_in_a_421_has_a_name_that_leads_to_it(tmp_path: Path) -> None:
    objects = rendered(tmp_path, SMALL)
    edges, service = objects["StatefulSet", "fleet-aicvds"], objects["Service", "fleet-aicvds-edges"]
    assert edges["spec"]["serviceName"] == "fleet-aicvds-edges" and service["spec"]["clusterIP"] == "None"
    assert service["spec"]["publishNotReadyAddresses"] is True
    expected = "http://fleet-aicvds-0.fleet-aicvds-edges.uavs.svc.cluster.local:8000"
    assert environment(objects)["AICVDS_ADVERTISE_URL"] == expected
    labels = edges["spec"]["template"]["metadata"]["labels"].items()
    for one in objects.values():
        if one["kind"] == "Service":
            assert one["spec"]["selector"].items() <= labels


def test_the_container_is_as_the_image_and_compose_have_it(objects: Objects) -> None:
    pod = objects["StatefulSet", "fleet-aicvds"]["spec"]["template"]["spec"]
    (edge,) = pod["containers"]
    dockerfile = (ROOT / "docker" / "edge.Dockerfile").read_text()
    user, port = pod["securityContext"]["runAsUser"], edge["ports"][0]["containerPort"]
    assert f"USER {user}:{user}\n" in dockerfile and f"EXPOSE {port}\n" in dockerfile
    assert edge["securityContext"]["readOnlyRootFilesystem"] and pod["securityContext"]["runAsNonRoot"]
    compose = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["edge"]
    drain = edge.get("lifecycle", {}).get("preStop", {}).get("exec", {}).get("command", ["sleep", "0"])[1]
    assert pod["terminationGracePeriodSeconds"] - int(drain) >= int(compose["stop_grace_period"].removesuffix("s"))


@pytest.mark.parametrize(
    ("version", "policy"), [("1.26.9", None), ("1.27.0", "AlwaysAllow"), ("1.37.1", "AlwaysAllow")]
)
def test_an_edge_that_is_not_ready_may_be_evicted(tmp_path: Path, version: str, policy: str | None) -> None:
    (tmp_path / "values.yaml").write_text(yaml.safe_dump(LARGE))
    shown = ("--values", str(tmp_path / "values.yaml"), "--show-only", "templates/disruptionbudget.yaml")
    done = run("template", str(CHART), "--kube-version", version, *shown)
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load(done.stdout)["spec"].get("unhealthyPodEvictionPolicy") == policy


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"image": {"tag": "1"}}, "API keys"),
        ({"settings": {"AICVDS_ANONYMOUS": "on"}}, "image.tag"),
        ({"image": {"tag": "1"}, "settings": {"AICVDS_MDOE": "llm"}}, "AICVDS_MDOE"),
        ({"image": {"tag": "1"}, "settings": {"AICVDS_STORE": "postgresql://u:p@h/d"}}, "AICVDS_STORE"),
        ({"image": {"tag": "1"}, "graceSeconds": 5}, "graceSeconds"),
        ({"image": {"tag": "1"}, "replica": 3}, "replica"),
        (
            {"image": {"tag": "1"}, "keys": {"secretName": "keys"}, "metrics": {"scrape": "serviceMonitor"}},
            "metrics.keySecret",
        ),
    ],
)
def test_a_value_that_cannot_be_meant_is_refused(tmp_path: Path, values: dict[str, Any], fault: str) -> None:
    (tmp_path / "values.yaml").write_text(yaml.safe_dump(values))
    done = run("template", str(CHART), "--values", str(tmp_path / "values.yaml"))
    assert done.returncode != 0 and fault in done.stderr
