"""The ``aicvds`` command's front: which extra a missing module belongs to, and which errors are ours."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from shared import cli


def run(monkeypatch: pytest.MonkeyPatch, missing: str, name: str = "bound") -> int:
    """Run a command that misses a module."""

    def load() -> object:
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    command = SimpleNamespace(name=name, value="simulator.commands.bound:main", load=load)
    monkeypatch.setattr(cli, "entry_points", lambda group: [command])
    monkeypatch.setattr(cli, "find_spec", lambda module: object() if module == "matplotlib" else None)
    monkeypatch.setattr(sys, "argv", ["aicvds", name, "--seed", "0"])
    return cli.main()


@pytest.mark.parametrize(
    "name, missing, extra",
    [("bound", "ortools.sat", "planner"), ("bound", "pettingzoo", "simulator"), ("train", "torchrl", "marl")],
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
