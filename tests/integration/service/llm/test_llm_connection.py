"""The way to an LLM server: a private certificate authority, a proxy that is gone, and no server at all."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
import trustme

from tests.support.running import serving
from tests.support.stub_llm import StubLlm, wait_for

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]


def test_a_private_authority_must_be_named_and_is_trusted_then(
    edge: Edge, report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "authority.pem")
    authority.issue_cert("127.0.0.1").private_key_and_cert_chain_pem.write_to_path(tmp_path / "server.pem")
    with serving(StubLlm().app, certificate=str(tmp_path / "server.pem")) as url:
        unknown = edge(mode="llm", llm_url=f"{url}/v1")
        detail = wait_for(unknown, "unavailable")["detail"]
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "authority.pem"))
        trusting = edge(mode="llm", llm_url=f"{url}/v1")
        wait_for(trusting, "ready")
        assert trusting.post("/decide", json=report()).json()["source"] == "llm"
    assert "the certificate is not trusted: " in detail
    assert "SSL_CERT_FILE" in detail


def test_a_certificate_for_another_host_is_named(edge: Edge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "authority.pem")
    authority.issue_cert("llm.example").private_key_and_cert_chain_pem.write_to_path(tmp_path / "server.pem")
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "authority.pem"))
    with serving(StubLlm().app, certificate=str(tmp_path / "server.pem")) as url:
        detail = wait_for(edge(mode="llm", llm_url=f"{url}/v1"), "unavailable")["detail"]
    assert "IP address mismatch, certificate is not valid for '127.0.0.1'" in detail


def test_a_proxy_that_is_gone_is_named(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    monkeypatch.setenv("HTTP_PROXY", f"http://user:secret@127.0.0.1:{port}")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    detail = wait_for(edge(mode="llm", llm_url="http://llm.invalid/v1"), "unavailable")["detail"]
    assert "the proxy of the environment: " in detail
    assert "secret" not in detail


def test_a_server_that_is_gone_is_named_with_the_systems_reason(edge: Edge) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    detail = wait_for(edge(mode="llm", llm_url=f"http://127.0.0.1:{port}/v1"), "unavailable")["detail"]
    assert detail == f"http://127.0.0.1:{port}/v1: ClientConnectorError: Connection refused"
