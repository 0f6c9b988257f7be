"""``aicvds`` and ``aicvds serve`` as processes."""

import asyncio
import json
import re
import signal
import socket
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.edge_stub import free_port
from tests.support.processes import output_until, run, run_here, serving_edge, started
from tests.support.running import listening
from tests.support.stub_llm import misbehaving, wait_for
from tests.support.waiting import PATIENCE_S, Gate, until


@pytest.fixture
def unmarked(monkeypatch: pytest.MonkeyPatch) -> None:
    """``aicvds serve`` in this process leaves its log and its allocator as they are for the tests after it."""
    monkeypatch.setattr("service.observability.logs.configure", lambda *_: None)
    monkeypatch.setattr("service.server.server.hand_back_memory", lambda: None)


def test_help_names_every_command() -> None:
    shown = run_here("--help")
    assert shown.returncode == 0
    for command in ("serve", "simulate", "demo", "keys", "model"):
        assert command in shown.stdout


@pytest.mark.parametrize(
    ("words", "without"),
    [
        (["--version"], {"torch", "numpy", "fastapi", "pydantic", "scipy", "tyro", "rich", "httpx"}),
        (["--help"], {"torch", "numpy", "fastapi", "pydantic", "scipy", "tyro", "rich", "httpx"}),
        (["serve", "--help"], {"torch", "numpy", "fastapi", "scipy", "sqlalchemy", "httpx", "rich", "uvicorn"}),
    ],
)
def test_help_imports_nothing_that_takes_long(words: list[str], without: set[str]) -> None:
    shown = run(*words, PYTHONPROFILEIMPORTTIME="1")
    assert shown.returncode == 0 and shown.stdout
    imported = set(re.findall(r"^import time:.*\| +(\S+)$", shown.stderr, re.MULTILINE))
    assert "shared.kit.command_line" in imported
    assert not imported & without


def test_the_version_is_that_of_the_package() -> None:
    assert run_here("--version").stdout == f"aicvds {version('aic-vds')}\n"


@pytest.mark.parametrize("command", ["serve", "simulate", "demo", "keys", "model"])
def test_every_command_explains_itself(command: str) -> None:
    shown = run_here(command, "--help")
    assert shown.returncode == 0, shown.stderr
    assert f"aicvds {command}" in shown.stdout


@pytest.mark.parametrize(
    ("args", "env", "said"),
    [
        (["sail"], {}, "no command 'sail'"),
        (["serve", "--port", "70000"], {}, "--port: must be less than or equal to 65535"),
        (["serve"], {"AICVDS_TOP_K": "0"}, "AICVDS_TOP_K"),
        (["serve"], {"AICVDS_LLM_URL": "localhost:8080"}, "AICVDS_LLM_URL"),
        (["model", "fly"], {}, "aicvds model fetch"),
        (["serve", "--port", "0"], {"AICVDS_KEYS": "/no/keys.json"}, "AICVDS_KEYS: /no/keys.json: No such file"),
        (["serve", "--port", "0", "--host", "0.0.0.0"], {}, "aicvds keys add"),
        (["serve", "--port", "0", "--host", "0.0.0.0"], {"AICVDS_ANONYMOUS": "off"}, "AICVDS_ANONYMOUS=on"),
    ],
)
@pytest.mark.usefixtures("unmarked")
def test_bad_use_is_one_clear_line_and_exit_2(args: list[str], env: dict[str, str], said: str) -> None:
    ended = run_here(*args, **env)
    assert ended.returncode == 2
    assert said in ended.stderr + ended.stdout
    assert "Traceback" not in ended.stderr


@pytest.mark.long
def test_other_addresses_are_served_with_keys_or_when_told_to(tmp_path: Path) -> None:
    keys = str(tmp_path / "keys.json")
    key = run("keys", "add", "fleet", "--file", keys).stdout.strip()
    for env in ({"AICVDS_KEYS": keys}, {"AICVDS_ANONYMOUS": "on"}):
        with started("serve", "--port", "0", "--host", "0.0.0.0", AICVDS_MODE="policy", **env) as process:
            port = output_until(process, r"listening on http://0\.0\.0\.0:(\d+)")[1]
            url = f"http://127.0.0.1:{port}/metrics"
            assert httpx.get(url, timeout=PATIENCE_S).status_code == (401 if "AICVDS_KEYS" in env else 200)
            assert httpx.get(url, timeout=30, headers={"Authorization": f"Bearer {key}"}).status_code == 200


def test_a_busy_port_is_one_clear_line() -> None:
    with serving_edge() as (url, _):
        second = run("serve", "--port", url.rsplit(":", 1)[1])
    assert second.returncode == 2
    assert "cannot listen on 127.0.0.1" in second.stderr
    assert "Traceback" not in second.stderr


@pytest.mark.usefixtures("unmarked")
def test_a_misspelt_setting_is_told() -> None:
    reported = run_here("serve", AICVDS_TOPK="3", AICVDS_TOP_K="0")
    assert "AICVDS_TOP_K" in reported.stderr
    with started("serve", "--port", "0", AICVDS_PROCESSES="2", AICVDS_TOPK="3") as process:
        replaced = "AICVDS_PROCESSES is no setting and changes nothing: several edges share one PostgreSQL"
        misspelt = "AICVDS_TOPK is no setting and changes nothing; did you mean AICVDS_TOP_K?"
        output_until(process, rf"{replaced}[^\0]*{re.escape(misspelt)}")


def test_host_port_and_every_line_of_a_json_log_come_from_the_environment() -> None:
    port = str(free_port())
    env = {"AICVDS_HOST": "::1", "AICVDS_PORT": port, "AICVDS_LOG_FORMAT": "json", "AICVDS_TOPK": "3"}
    with started("serve", AICVDS_MODE="policy", **env) as process:
        url = f"http://[::1]:{port}"
        seen = output_until(process, rf"listening on {re.escape(url)}").string
        until(lambda: httpx.get(f"{url}/readyz", timeout=PATIENCE_S).is_success)
        process.terminate()
        seen += process.communicate(timeout=PATIENCE_S)[0]
    lines = [json.loads(line) for line in seen.splitlines()]
    assert "AICVDS_TOPK is no setting" in lines[0]["event"] and lines[0]["level"] == "warning"
    env |= {"AICVDS_PORT": "tcp://10.0.0.7:8000", "AICVDS_MODE": "fast"}
    faults = [json.loads(line) for line in run("serve", **env).stderr.splitlines()]
    assert [fault["event"].split(":")[1].strip() for fault in faults[1:]] == ["AICVDS_MODE", "AICVDS_PORT"]
    assert {fault["level"] for fault in faults[1:]} == {"error"}


def test_nothing_runs_before_the_settings_are_checked(tmp_path: Path) -> None:
    for args, env in (
        (["--mode", "llm", "--llm-url", "localhost:1"], {}),
        ([], {"AICVDS_KEYS": str(tmp_path / "none.json")}),
        (["--host", "0.0.0.0"], {}),
    ):
        refused = run("serve", "--port", "0", *args, **env)
        assert refused.returncode == 2
        assert "listening" not in refused.stderr and "Value error" not in refused.stderr


@pytest.mark.usefixtures("unmarked")
@pytest.mark.parametrize(
    ("args", "env", "why"),
    [
        (["--ray", "local"], {}, "a store only in PostgreSQL"),
        (["--ray", "local", "--replicas", "4-2"], {"AICVDS_STORE": "postgresql://h/d"}, "--replicas 4-2"),
        (["--ray", "local"], {"AICVDS_STORE": "postgres://h/d"}, "ray is not installed. Install the extra"),
        # The edges on a cluster listen on their machines' addresses, even where the ingress does not.
        (["--ray", "10.0.0.7:6379"], {"AICVDS_STORE": "postgresql://h/d"}, "anyone who reaches Ray at 10.0.0.7:6379"),
    ],
)
def test_what_edges_on_ray_cannot_have_is_refused(
    args: list[str], env: dict[str, str], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    refused = run_here("serve", "--port", "0", *args, **env)
    assert refused.returncode == 2 and why in refused.stderr and "Traceback" not in refused.stderr


def test_the_banner_says_what_runs_and_what_to_type_next(tmp_path: Path) -> None:
    store = tmp_path / "missions.db"
    with started("serve", "--port", "0", "--mode", "value", "--store", str(store), AICVDS_MODE="policy") as process:
        url, lines = output_until(process, r"listening on (http://[\d.:]+)[^\0]*ready\n((?:  .*\n){5})").groups()
        assert httpx.put(f"{url}/missions/m", json={}, timeout=PATIENCE_S).json()["mode"] == "value"
    reported = dict(line.split(maxsplit=1) for line in lines.strip().splitlines())
    assert reported["page"] == f"{url}/"
    assert reported["decides"] == "mode value, without an LLM"
    assert reported["store"] == f"{store}, 0 missions"
    assert reported["next"] == f"aicvds simulate --edge {url} --out runs/mission"
    assert store.exists()


def test_the_log_of_a_start_is_short_and_plain(tmp_path: Path) -> None:
    with started("serve", "--port", "0", AICVDS_MODE="value", AICVDS_STORE=str(tmp_path / "m.db")) as process:
        said = output_until(process, r"[^\0]*next .*\n")[0]
    assert "alembic" not in said and "color_message" not in said


def test_ctrl_c_while_loading_is_quiet() -> None:
    with started("serve", "--port", "0") as process:
        output_until(process, "loading")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in (0, 130, -signal.SIGINT)
    assert "Traceback" not in output


def test_it_stops_when_asked_in_its_first_second() -> None:
    ask = signal.SIGTERM
    with serving_edge() as (url, process):
        assert httpx.get(f"{url}/healthz", timeout=PATIENCE_S).status_code == 200
        process.send_signal(ask)
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert "Traceback" not in output


def test_a_decision_asked_for_before_it_is_loaded_is_answered(report: Callable[..., dict[str, Any]]) -> None:
    with serving_edge(AICVDS_MODE="policy") as (url, _):
        answer = httpx.post(f"{url}/decide", json=report(mission_id="default", deadline_ms=60_000), timeout=PATIENCE_S)
    assert (answer.status_code, answer.json()["source"]) == (200, "policy")


@pytest.mark.parametrize(("ask", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_the_edge_stops_when_asked(ask: signal.Signals, code: int) -> None:
    with serving_edge() as (url, process):
        assert httpx.get(f"{url}/readyz", timeout=PATIENCE_S).status_code == 200
        process.send_signal(ask)
        assert process.wait(PATIENCE_S) == code


def test_a_decision_in_flight_is_answered_before_the_edge_stops(report: Callable[..., dict[str, Any]]) -> None:
    """Its LLM is silent and its deadline far: the policy answers, in less time than `docker stop` grants."""
    gate = Gate()

    async def held(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await gate.passed()

    with (
        listening(misbehaving(held)) as llm,
        serving_edge(AICVDS_LLM_URL=f"{llm}/v1", AICVDS_LLM_MODEL="x") as (url, process),
        httpx.Client(base_url=url, timeout=PATIENCE_S) as client,
        ThreadPoolExecutor() as pool,
    ):
        wait_for(client, "ready")
        waiting = pool.submit(client.post, "/decide", json=report(mission_id="default", deadline_ms=60_000))
        until(lambda: gate.callers)
        process.send_signal(signal.SIGTERM)
        answer = waiting.result(timeout=PATIENCE_S)
        process.wait(PATIENCE_S)
    assert (answer.status_code, answer.json()["reason"]) == (200, "llm_timeout")


@pytest.mark.long
def test_who_has_connected_before_the_edge_stops_is_answered(report: Callable[..., dict[str, Any]]) -> None:
    body = json.dumps(report(mission_id="default")).encode()
    head = "POST /decide HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    head += f"Content-Length: {len(body)}\r\n\r\n"
    with serving_edge(AICVDS_MODE="policy") as (url, process):
        assert httpx.get(f"{url}/readyz", timeout=PATIENCE_S).status_code == 200
        door = ("127.0.0.1", int(url.rpartition(":")[2]))
        # Stopped for longer than uvicorn's tick, the edge finds the connection and the signal together when it goes on.
        process.send_signal(signal.SIGSTOP)
        with socket.create_connection(door, timeout=PATIENCE_S) as early:
            early.sendall(head.encode() + body)
            process.send_signal(signal.SIGTERM)
            time.sleep(0.15)
            process.send_signal(signal.SIGCONT)
            assert early.recv(65536).startswith(b"HTTP/1.1 200")
        process.wait(PATIENCE_S)


@pytest.mark.long
def test_empty_variables_are_unset_ones(tmp_path: Path) -> None:
    """docker-compose passes every variable on, set or not."""
    empty = {f"AICVDS_{name}": "" for name in ("LLM_URL", "LLM_MODEL", "LLM_API_KEY", "LLM_GGUF", "MODE", "TOP_K")}
    with serving_edge(**empty) as (url, _):
        assert httpx.get(f"{url}/readyz", timeout=PATIENCE_S).json()["llm"] in ("loading", "ready")
