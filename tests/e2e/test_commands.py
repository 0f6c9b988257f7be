"""Every command that the README, the docs and the examples show is run as shown, or listed here with the reason."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import tyro

from lab.commands.experiment import FIGURES, MAP
from lab.experiments.catalogue import EXPERIMENTS
from shared.client.edge_client import EdgeClient
from shared.kit import command_line as cli
from tests.support.edge_stub import free_port
from tests.support.places import ROOT
from tests.support.processes import serving_edge
from tests.support.waiting import PATIENCE_S

PAGES = [
    *(ROOT / "README.md", ROOT / "CONTRIBUTING.md"),
    *sorted(ROOT.glob("docs/**/*.md")),
    *sorted(ROOT.glob("examples/*/README.md")),
]
EDGE = "http://localhost:8000"
BIN = ".venv/bin/"

# Run as they stand, in this order, beside an edge: what is added makes them short.
FLOWN = {
    f"{BIN}aicvds simulate --edge {EDGE} --scenario paper --seed 0 --out runs/mission": "--steps 2",
    f"{BIN}aicvds replay runs/mission --edge {EDGE} --top-k 3 --out runs/again": "",
    f"{BIN}aicvds simulate --world examples/pipeline_world --edge {EDGE}": "--steps 2",
    f"{BIN}aicvds simulate --world examples/pipeline_world --policy eof --out runs/pipeline_world": "--steps 2",
    f"{BIN}aicvds simulate --policy eof --no-bound --out runs/eof": "--steps 2",
    f"{BIN}aicvds simulate --edge {EDGE} --mission patrol --out runs/patrol": "--steps 2 --no-bound",
    f"{BIN}aicvds compare runs/mission runs/eof": "",
    f"{BIN}aicvds mission create --edge {EDGE} --world examples/pipeline_world": "",
    f"{BIN}aicvds world export examples/pipeline_world --plan runs/plans": "",
    f"{BIN}aicvds world import runs/plans/*.plan --out runs/from_plans": "",
}
# The edge that the others are flown against is this one; the commands of "Keys" have an edge of their own.
SERVED = [
    f"{BIN}aicvds serve",
    f"AICVDS_LLM_URL=http://localhost:11434/v1 AICVDS_LLM_MODEL=llama3.2:3b {BIN}aicvds serve",
    "AICVDS_LLM_URL=http://localhost:8081/v1,http://localhost:8082/v1 AICVDS_LLM_ORDER=mission AICVDS_LLM_SLOTS=4 "
    f"{BIN}aicvds serve",
    "AICVDS_LLM_URL=https://api.openai.com/v1 AICVDS_LLM_MODEL=gpt-4o-mini AICVDS_LLM_API_KEY=sk-… \\\n"
    "AICVDS_LLM_ADAPTER=off AICVDS_VERIFY=off AICVDS_MODE=llm AICVDS_DEADLINE_MS=10000 \\\n"
    f"AICVDS_PRICE_INPUT=0.15 AICVDS_PRICE_CACHED=0.075 AICVDS_PRICE_OUTPUT=0.6 {BIN}aicvds serve",
]
KEYED = [
    f"KEY=$({BIN}aicvds keys add fleet-1 --file keys.json --scopes decide admin)",
    f"AICVDS_KEYS=keys.json {BIN}aicvds serve --host 0.0.0.0 &",
    f"AICVDS_API_KEY=$KEY {BIN}aicvds simulate --edge {EDGE} --out runs/mission",
]
# Their command lines are parsed and no more; by how they begin.
PARSED = {
    "aicvds doctor": "its result is this machine's; tests/integration/service/commands/test_doctor.py runs it",
    "aicvds simulate --policy fullest.py": "the reader's class; test_simulate.py flies one of its own",
    "aicvds serve --ray": "it needs a PostgreSQL; tests/faults/test_ray.py runs it",
    "aicvds mqtt": "it goes on until it is ended; tests/e2e/test_mqtt.py runs it with a broker",
    "aicvds fly": "it waits for vehicles; tests/unit/field/vehicles and tests/e2e/test_fly.py fly it",
    "python -m lab experiment": "minutes to hours; tests/lab/commands/test_experiment.py runs them small",
    "python -m lab train": "minutes to hours; tests/lab/marl runs it small",
    "python -m lab explore": "minutes; tests/lab/commands/test_pretrain.py runs it small",
    "python -m lab distill": "an hour; tests/lab/distilling/test_distill.py runs it small",
    "python -m lab distill-orders": "an hour; tests/lab/distilling/test_distill_orders.py runs it small",
    "python -m lab pretrain": "minutes; tests/lab/commands/test_pretrain.py runs it small",
    "python -m benchmarks.": "minutes to hours, and they measure; tests/benchmarks runs them small",
    "python -m lab.benchmarks.": "minutes to hours, and they measure; tests/lab/benchmarks runs them small",
}
# `make --dry-run` finds their targets.
MADE = {
    "make install": "what runs this was installed by it",
    "make demo": "`aicvds demo` is `serve` and `simulate`, which are run here",
    "make test": "this is part of it",
    "make test-long": "minutes; CI runs it",
    "make check": "CI runs it",
    "make compose": "it needs a Docker engine; CI runs it",
    "make bench": "half an hour, and it measures",
    "make faults": "ten minutes",
    "make fuzz": "some minutes; tests/integration/service/api/test_fuzz.py is a short one",
    "make soak": "ten minutes",
    "make docs": "tests/integration/test_docs.py builds the pages",
    "make release": "minutes; it tries what it builds",
}
# Programs that this package does not bring.
OTHERS = {
    "docker compose ": "it needs a Docker engine; `make compose` does the same",
    "kubectl ": "it needs a cluster",
    "helm install": "it needs a cluster; a test has Helm and Kubernetes' schemas check the chart",
    "llama-server ": "it needs a model of the reader's; the tests' servers are those of the embedded llama.cpp",
}
# Run by tests/e2e/test_readme.py, as they stand.
CURLED, CURLED_ON = "curl ", ("README.md", "docs/guides/operator.md")


def commands(page: Path) -> list[str]:
    """The commands of a page's `sh` blocks, without comments, a command that goes over lines as one."""
    found: list[str] = []
    for block in re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        whole = ""
        for line in block.splitlines():
            whole += line + "\n"
            if complete(whole):
                found.append(whole.strip())
                whole = ""
        assert not whole, f"{page}: a command has no end: {whole}"
    return [re.sub(r"\s+#\s.*$", "", command) for command in found if not command.startswith("#")]


def complete(text: str) -> bool:
    """Whether no quote is open and no line goes on."""
    try:
        shlex.split(text, comments=True)
    except ValueError:
        return False
    return not text.endswith("\\\n")


def reported() -> list[tuple[str, str]]:
    """Every command, with its page."""
    return [(page.relative_to(ROOT).as_posix(), command) for page in PAGES for command in commands(page)]


def begins(command: str, how: dict[str, str]) -> bool:
    return any(command.removeprefix(BIN).startswith(start) for start in how)


TOLD = reported()


@pytest.mark.parametrize(("page", "command"), TOLD)
def test_every_command_is_in_a_list(page: str, command: str) -> None:
    listed = [
        command in FLOWN,
        command in SERVED,
        command in KEYED,
        begins(command, PARSED),
        begins(command, MADE),
        begins(command, OTHERS),
        command.startswith(CURLED) and page in CURLED_ON,
    ]
    assert sum(listed) == 1, f"{page} shows {command!r}: run it in this test, or list it with the reason"


def test_every_list_is_of_commands_that_are_shown() -> None:
    shown = {command for _, command in TOLD}
    assert {*FLOWN, *SERVED, *KEYED} <= shown
    assert all(any(begins(command, {start: ""}) for command in shown) for start in {**PARSED, **MADE, **OTHERS})


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A directory that looks to the commands like the repository, and keeps what they write."""
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


def shell(command: str, workspace: Path) -> str:
    """Run it as a shell does; returns what it prints."""
    ended = subprocess.run(
        ["bash", "-c", command], cwd=workspace, capture_output=True, text=True, timeout=170, check=False
    )
    assert ended.returncode == 0, f"{command} ended with {ended.returncode}:\n{ended.stdout}\n{ended.stderr}"
    return ended.stdout


@pytest.mark.long
def test_missions_are_flown_as_shown(workspace: Path) -> None:
    # Who decides is not asked here, and the policy is the quickest.
    with serving_edge(AICVDS_MODE="policy") as (url, _):
        for command, more in FLOWN.items():
            shell(f"{command} {more}".replace(EDGE, url), workspace)
        decided = httpx.get(f"{url}/metrics", timeout=PATIENCE_S).text
    assert "aicvds_decisions_total{" in decided
    for written in (
        "mission/summary.json",
        "mission/report.html",
        "again/replay.json",
        "pipeline_world/report.html",
        "compare.html",
    ):
        assert (workspace / "runs" / written).stat().st_size > 0


@contextmanager
def in_the_background(command: str, workspace: Path) -> Iterator[None]:
    process = subprocess.Popen(["bash", "-c", f"exec {command}"], cwd=workspace, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.kill()
        process.wait(PATIENCE_S)


@pytest.mark.long
def test_an_edge_with_keys_is_flown_as_shown(workspace: Path) -> None:
    make, serve, fly = KEYED
    key = shell(f"{make}; echo $KEY", workspace).strip()
    port = free_port()
    url = f"http://localhost:{port}"
    # `exec` takes no assignments before it.
    settings, _, rest = serve.partition(" ")
    with in_the_background(f"env {settings} AICVDS_MODE=policy {rest.removesuffix(' &')} --port {port}", workspace):
        with EdgeClient(url) as waiting:
            waiting.wait_ready(PATIENCE_S)
        assert httpx.get(f"{url}/missions/none", timeout=PATIENCE_S).status_code == 401
        shell(f"KEY={key}; {fly.replace(EDGE, url)} --steps 2", workspace)
    assert (workspace / "runs" / "mission" / "summary.json").exists()


@pytest.mark.parametrize("command", [command for _, command in TOLD if begins(command, PARSED)])
def test_what_takes_long_is_at_least_understood(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, *args = shlex.split(command.removeprefix(BIN))
    if args[:3] == ["-m", "lab", "experiment"]:
        assert args[3] in (*EXPERIMENTS, "all", "page", MAP, FIGURES)
    with monkeypatch.context() as patched:
        patched.setattr(tyro, "cli", only_parsed(tyro.cli))
        if program == "aicvds":
            patched.setattr(sys, "argv", [program, *args])
            with pytest.raises(Understood):
                cli.main()
        else:
            assert args[0] == "-m"
            patched.setattr(sys, "argv", args[1:])
            # A test of the same process may have imported it.
            patched.delitem(sys.modules, args[1], raising=False)
            with pytest.raises(Understood):
                runpy.run_module(args[1], run_name="__main__", alter_sys=True)


class Understood(Exception):
    """The command line was parsed."""


def only_parsed(parse: Callable[..., object]) -> Callable[..., object]:
    def parsed(*args: Any, **kwargs: Any) -> object:
        parse(*args, **kwargs)
        raise Understood

    return parsed


@pytest.mark.parametrize("command", sorted({command for _, command in TOLD if begins(command, MADE)}))
def test_what_is_made_has_a_target(command: str) -> None:
    target = shlex.split(command.replace("<that address>", "address"))[1]
    planned = subprocess.run(
        ["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True, check=False, env=dict(os.environ)
    )
    assert planned.returncode == 0, planned.stderr
