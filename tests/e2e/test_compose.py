"""docker-compose.yml as text: what it mounts is there, what it takes is in .env.example. `make compose` runs it."""

from __future__ import annotations

import re

import httpx
import pytest
import yaml
from starlette.responses import Response

from service.api.authentication import KnownHosts
from service.config.settings import Settings
from tests.support.places import ROOT

TEXT = (ROOT / "docker-compose.yml").read_text()
SERVICES, VOLUMES = (yaml.safe_load(TEXT)[part] for part in ("services", "volumes"))
LINES = dict(re.findall(r"^#(\w+)=(.*?)(?:  # .*)?$", (ROOT / ".env.example").read_text(), re.MULTILINE))
# Taken by Compose itself, or by programs in the containers, under their own names.
PASSED_ON = {"HF_TOKEN", "COMPOSE_PROFILES"}


def test_every_variable_is_told_of_with_its_default() -> None:
    defaults = dict(re.findall(r"\$\{(\w+):-([^}]*)\}", TEXT))
    assert len(defaults) == len({*re.findall(r"\$\{(\w+)", TEXT)})
    # Examples rather than defaults, as their comments say.
    examples = {"AICVDS_RUNS", "AICVDS_USER", "AICVDS_KEYS_DIR", "AICVDS_HOSTS", "AICVDS_READINGS_KEY"}
    # Of a line without a value, uncommented, the comment would be the value.
    assert all(LINES.values())
    assert {name: LINES.get(name) for name in defaults if name not in examples} == {
        name: default for name, default in defaults.items() if name not in examples
    }
    assert examples | PASSED_ON <= LINES.keys()


def test_every_example_is_of_a_variable_that_something_reads() -> None:
    listed = {name for service in SERVICES.values() for name in service.get("environment", ())}
    read = {*re.findall(r"\$\{(\w+)", TEXT), *(name.split("=")[0] for name in listed)}
    assert LINES.keys() - read == {"COMPOSE_PROFILES"}


def test_without_a_profile_there_are_the_edge_the_simulator_and_prometheus() -> None:
    assert {name for name, service in SERVICES.items() if "profiles" not in service} == {
        "edge",
        "simulator",
        "prometheus",
    }
    profiles = {profile for service in SERVICES.values() for profile in service.get("profiles", ())}
    assert profiles == {"grafana", "llama", "vllm", "ollama", "postgres", "mqtt"}
    assert all(f"#   {profile} " in TEXT for profile in profiles)


def test_what_runs_until_it_is_stopped_comes_back_after_a_reboot() -> None:
    ends_by_itself = {"simulator": None, "ollama-pull": "on-failure:10"}
    assert {name: service.get("restart") for name, service in SERVICES.items()} == {
        name: ends_by_itself.get(name, "unless-stopped") for name in SERVICES
    }


def test_what_is_written_is_in_a_volume_with_a_name() -> None:
    """An image's own volume without a name is a new, empty one each time that its container is made again."""
    mounts = [mount.split(":") for service in SERVICES.values() for mount in service.get("volumes", ())]
    named = {source for source, *_ in mounts if source.isalpha()}
    assert named | {"keys", "runs"} == VOLUMES.keys()
    [folder] = [word.split("=")[1] for word in SERVICES["prometheus"]["command"] if "tsdb.path=" in word]
    assert ["prometheus", folder] in mounts


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_is_of_one_version_and_sees_no_more_than_it_needs(name: str) -> None:
    service = SERVICES[name]
    if "image" in service:
        assert re.fullmatch(r"\$\{\w+:-[\w./-]+:[\w.-]*\d[\w.-]*\}", service["image"])
    assert service["cap_drop"] == ["ALL"] and service["security_opt"] == ["no-new-privileges:true"]
    for mount in service.get("volumes", ()):
        source = mount.split(":")[0]
        if source.startswith("./"):
            assert (ROOT / source).exists() and mount.endswith(":ro")
    for port in service.get("ports", ()):
        assert port.startswith("${AICVDS_BIND:-127.0.0.1}:")
    # Every LLM server, store and broker is named as the comment at the top says, or by a default.
    if service.get("profiles", ["grafana"]) != ["grafana"] and name not in ("ollama-pull", "uplinks"):
        assert f"//{name}:" in TEXT or f"@{name}/" in TEXT


def test_prometheus_scrapes_where_the_containers_listen() -> None:
    config = yaml.safe_load((ROOT / "docker" / "prometheus.yml").read_text())
    targets = {job["static_configs"][0]["targets"][0] for job in config["scrape_configs"]}
    ports = {
        f"{name}:{word.split('=')[1]}"
        for name, service in SERVICES.items()
        for word in service.get("command", ())
        if word.startswith("--metrics-port=")
    }
    assert targets == {"edge:8000", *ports} and len(ports) == 2


@pytest.mark.parametrize("own", ["", "fleet.example.org", "*"])
async def test_an_operators_names_add_to_the_containers_own(own: str) -> None:
    [line] = [line for line in SERVICES["edge"]["environment"] if line.startswith("AICVDS_HOSTS=")]
    hosts = line.partition("=")[2].replace("${AICVDS_HOSTS:-}", own)
    edge = KnownHosts(Response(status_code=204), Settings(hosts=hosts, store="none"))
    async with httpx.AsyncClient(transport=httpx.ASGITransport(edge)) as client:
        names = ("edge:8000", "fleet.example.org")
        found = [(await client.get(f"http://{name}/")).status_code for name in names]
    assert found == [204, 204 if own else 403]
