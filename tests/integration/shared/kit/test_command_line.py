"""The ``aicvds`` command's front: which extra a missing module belongs to, and which errors are ours."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from types import SimpleNamespace

import pytest

from shared.kit import command_line as cli
from tests.support.places import ROOT


def run(monkeypatch: pytest.MonkeyPatch, missing: str, name: str = "bound") -> int:
    """Run a command that misses a module."""

    def load() -> object:
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    package = "service" if name == "serve" else "simulator"
    command = SimpleNamespace(name=name, value=f"{package}.commands.bound:main", load=load)
    monkeypatch.setattr(cli, "entry_points", lambda group: [command])
    monkeypatch.setattr(cli, "find_spec", lambda module: object() if module == "matplotlib" else None)
    monkeypatch.setattr(sys, "argv", ["aicvds", name, "--seed", "0"])
    return cli.main()


@pytest.mark.parametrize(
    ("name", "missing", "extra"),
    [
        ("bound", "ortools.sat", "bound"),
        ("simulate", "numba", "planner"),
        ("serve", "numba", "service"),
        ("bound", "jinja2", "simulator"),
        ("mqtt", "paho", "mqtt"),
        ("mqtt", "httpx", "mqtt"),
    ],
)
def test_a_module_of_an_extra_that_is_not_installed_names_the_extra(
    name: str, missing: str, extra: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, missing, name) == 2
    error = capsys.readouterr().err
    assert f"pip install 'aic-vds[{extra}]'" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("missing", ["simulator.nowhere", "shared", "nmupy", "numpy.nowhere", "matplotlib.nowhere"])
def test_any_other_missing_module_is_a_traceback(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModuleNotFoundError, match=missing):
        run(monkeypatch, missing)


def test_an_installation_older_than_its_checkout_says_what_makes_it_new(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "entry_points", lambda group: [])
    monkeypatch.setattr(sys, "argv", ["aicvds", "bound"])
    assert cli.main() == 2
    lacks = capsys.readouterr().err
    # Its module has moved since.
    assert run(monkeypatch, "simulator.commands.bound") == 2
    for error in (lacks, capsys.readouterr().err):
        assert "older than its checkout" in error and "`make install`" in error
        assert "did you mean" not in error and error.count("\n") == 1


def test_every_command_of_the_help_is_installed_and_every_installed_one_is_in_the_help() -> None:
    metadata = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    entries = set(metadata["project"]["entry-points"]["aicvds.commands"])
    assert entries == {
        line.split()[0] for line in cli.usage().splitlines() if line.startswith("  ") and line[2] != " "
    } - {"aicvds"}


@pytest.mark.parametrize("arguments", [["--help"], ["simulate", "--help"]])
def test_a_reader_that_ends_early_gets_no_traceback(arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as output:
        command = [sys.executable, "-m", "shared.kit.command_line", *arguments]
        ended = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_another_broken_pipe_is_an_error_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(rest: list[str]) -> int:
        raise BrokenPipeError("a socket")

    command = SimpleNamespace(name="demo", value="simulator.commands.demo:main", load=lambda: broken)
    monkeypatch.setattr(cli, "entry_points", lambda group: [command])
    monkeypatch.setattr(sys, "argv", ["aicvds", "demo"])
    with pytest.raises(BrokenPipeError, match="a socket"):
        cli.main()
