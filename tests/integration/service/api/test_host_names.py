"""Without keys only this machine: a web page that gives its name this machine's address commands no edge."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.app import create_app
from service.config.settings import Settings
from tests.integration.service.api.test_authentication import bearer, made
from tests.support.waiting import PATIENCE_S

Edge = Callable[..., httpx.Client]
Report = Callable[..., dict[str, Any]]

FOREIGN = [
    *("evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "evil-localhost"),
    *("10.0.0.7", "192.0.2.1:8000", "[2001:db8::1]:8000", "0.0.0.0", "", "localhost@evil.example", "::", "2130706433"),
]
OWN = [*("localhost", "LOCALHOST:1", "localhost.", "127.0.0.1", "127.8.8.8:9", "[::1]", "[::1]:8000", "localhost:")]


@pytest.mark.parametrize("host", FOREIGN)
def test_a_foreign_name_is_refused_whatever_the_method(edge: Edge, report: Report, host: str) -> None:
    client = edge()
    assert client.put("/missions/m", json={}).status_code == 200
    routes = """PUT /missions/m, DELETE /missions/m, POST /decide, POST /missions/m/guidance, GET /missions,
    GET /missions/m, GET /missions/m/events, GET /, HEAD /, GET /healthz, GET /static/main.js, GET /missions/,
    GET /metrics, TRACE /, PATCH /missions/m, OPTIONS /decide, GET /nowhere, GET /openapi.json"""
    for method, path in (route.split() for route in routes.split(",")):
        answer = client.request(method, path, json=report(), headers={"Host": host})
        assert (answer.status_code, answer.headers["content-type"]) == (403, "application/problem+json"), path
        assert "evil" not in answer.text + str(answer.headers)
    assert client.get("/missions/m").status_code == 200


@pytest.mark.parametrize("host", OWN)
def test_this_machines_names_are_known(edge: Edge, host: str) -> None:
    assert edge().get("/missions", headers={"Host": host}).status_code == 200


def test_two_names_are_refused(edge: Edge) -> None:
    address = edge().base_url
    with socket.create_connection((address.host, address.port or 80), timeout=PATIENCE_S) as connection:
        connection.sendall(b"GET /missions HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 403 ")


@pytest.mark.parametrize(
    ("settings", "host", "status"),
    [
        ({"hosts": "edge, Fleet.example"}, "fleet.example:80", 200),
        ({"hosts": "edge, Fleet.example"}, "edge", 200),
        ({"hosts": "edge"}, "edge.example", 403),
        ({"hosts": "edge"}, "localhost", 200),
        ({"hosts": "edge:8000"}, "edge:8000", 200),
        ({"hosts": "[fd00::1]", "anonymous": "off"}, "[fd00::1]:8000", 200),
        ({"hosts": "[fd00::1]:8000", "anonymous": "off"}, "[fd00::1]", 200),
        ({"hosts": "*"}, "evil.example", 200),
        ({"anonymous": "on"}, "192.0.2.1:8000", 200),
        ({"anonymous": "on"}, "evil.example", 403),
        ({"advertise_url": "http://edge-1:8000"}, "edge-1:8000", 200),
        ({"advertise_url": "http://edge-1:8000"}, "edge-2:8000", 403),
    ],
)
def test_further_names_are_set(edge: Edge, settings: dict[str, str], host: str, status: int) -> None:
    assert edge(**settings).get("/missions", headers={"Host": host}).status_code == status


def test_with_keys_any_name_does(edge: Edge, tmp_path: Path) -> None:
    key = made(tmp_path / "keys.json", fleet=("decide",))["fleet"]
    client = edge(keys=tmp_path / "keys.json")
    assert client.get("/missions", headers={"Host": "fleet.example", **bearer(key)}).status_code == 200


@pytest.mark.parametrize("path", ["/missions/", "/decide/", "/static", "/healthz/", "/missions/m/"])
def test_no_redirect_repeats_a_name(edge: Edge, path: str) -> None:
    answer = edge(hosts="*").get(path, headers={"Host": "evil.example"})
    assert answer.status_code in (404, 405, 422) and "location" not in answer.headers


@pytest.mark.parametrize("path", ["/docs", "/redoc", "/docs/oauth2-redirect"])
def test_no_page_loads_scripts_of_another_host(edge: Edge, path: str) -> None:
    assert edge().get(path).status_code == 404


def test_every_page_is_the_edges_own() -> None:
    pages = [getattr(route, "path", "") for route in create_app(Settings(mode="value")).routes]
    assert {path for path in pages if not re.match("/(missions|decide|feedback|healthz|readyz|metrics)", path)} == {
        *("/", "/static", "/openapi.json")
    }
