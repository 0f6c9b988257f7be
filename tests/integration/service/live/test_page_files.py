"""The page's files are all that can be had from their folder; the paths are sent as they stand, by no HTTP client."""

from __future__ import annotations

import socket

import httpx

from service.api.live_routes import STATIC
from tests.conftest import Edge
from tests.support.waiting import PATIENCE_S

OUT = ("../broadcaster.py", "%2e%2e/broadcaster.py", "..%2fbroadcaster.py", "vendor/../../broadcaster.py")


def got(client: httpx.Client, path: str) -> tuple[int, bytes]:
    """The status and the body."""
    address = (client.base_url.host, client.base_url.port or 0)
    with socket.create_connection(address, timeout=PATIENCE_S) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n".encode())
        with connection.makefile("rb") as said:
            head, _, body = said.read().partition(b"\r\n\r\n")
    return int(head.split()[1]), body


def test_no_path_leaves_the_pages_folder(edge: Edge) -> None:
    assert (STATIC.parent / "broadcaster.py").is_file()
    client = edge()
    assert {path: got(client, f"/static/{path}")[0] for path in OUT} == dict.fromkeys(OUT, 404)


def test_a_path_within_the_pages_folder_may_turn_back(edge: Edge) -> None:
    client = edge()
    for path in ("main.js", "%6dain.js", "vendor/../main.js", "vendor/%2e%2e/main.js"):
        assert got(client, f"/static/{path}") == (200, (STATIC / "main.js").read_bytes())
