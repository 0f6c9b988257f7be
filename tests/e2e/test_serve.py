"""``aicvds`` and ``aicvds serve`` as processes."""

import signal
from pathlib import Path

import httpx
import pytest

from tests.e2e.processes import output_until, run, serving_edge, started


def test_help_names_every_command() -> None:
    shown = run("--help")
    assert shown.returncode == 0
    for command in ("serve", "simulate", "demo", "model"):
        assert command in shown.stdout


@pytest.mark.parametrize("command", ["serve", "simulate", "demo", "model"])
def test_every_command_explains_itself(command: str) -> None:
    shown = run(command, "--help")
    assert shown.returncode == 0, shown.stderr
    assert f"aicvds {command}" in shown.stdout


@pytest.mark.parametrize(
    ("args", "env", "said"),
    [
        (["fly"], {}, "no command 'fly'"),
        (["serve", "--port", "70000"], {}, "--port 70000"),
        (["serve"], {"AICVDS_TOP_K": "0"}, "AICVDS_TOP_K"),
        (["serve"], {"AICVDS_LLM_URL": "localhost:8080"}, "AICVDS_LLM_URL"),
        (["model", "fly"], {}, "aicvds model fetch"),
    ],
)
def test_bad_use_is_one_clear_line_and_exit_2(args: list[str], env: dict[str, str], said: str) -> None:
    ended = run(*args, **env)
    assert ended.returncode == 2
    assert said in ended.stderr + ended.stdout
    assert "Traceback" not in ended.stderr


def test_a_busy_port_is_one_clear_line() -> None:
    with serving_edge() as (url, _):
        second = run("serve", "--port", url.rsplit(":", 1)[1])
    assert second.returncode == 2
    assert "cannot listen on 127.0.0.1" in second.stderr
    assert "Traceback" not in second.stderr


def test_a_misspelt_setting_is_told() -> None:
    told = run("serve", AICVDS_TOPK="3", AICVDS_TOP_K="0")
    assert "AICVDS_TOP_K" in told.stderr
    with started("serve", "--port", "0", AICVDS_TOPK="3") as process:
        output_until(process, "AICVDS_TOPK is no setting")


def test_ctrl_c_while_loading_is_quiet() -> None:
    with started("serve", "--port", "0") as process:
        output_until(process, "loading")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=15)
    assert process.returncode in (0, 130, -signal.SIGINT)
    assert "Traceback" not in output


@pytest.mark.parametrize("ask", [signal.SIGTERM, signal.SIGINT])
def test_the_edge_stops_when_asked(ask: signal.Signals) -> None:
    with serving_edge() as (url, process):
        assert httpx.get(f"{url}/healthz").status_code == 200
        process.send_signal(ask)
        assert process.wait(timeout=15) in (0, 130, -ask)


def test_empty_variables_are_unset_ones(tmp_path: Path) -> None:
    """docker-compose passes every variable on, set or not."""
    empty = {f"AICVDS_{name}": "" for name in ("LLM_URL", "LLM_MODEL", "LLM_API_KEY", "LLM_GGUF", "MODE", "TOP_K")}
    with serving_edge(**empty) as (url, _):
        assert httpx.get(f"{url}/readyz").json()["llm"] in ("loading", "ready")
