"""What `make install` and `make demo` do with a .venv that is there.."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

import install
from tests.support.places import ROOT

OTHER = (sys.version_info[0], sys.version_info[1] - 1)


def checkout(folder: Path, version: tuple[int, int] = sys.version_info[:2]) -> Path:
    """A folder whose .venv has been installed into, with programs that only say where they are."""
    commands = folder / ".venv" / "bin"
    commands.mkdir(parents=True)
    (commands / "python").write_text(f"#!/bin/sh\necho '{version}' '{folder}/.venv'\n")
    (commands / "python").chmod(0o755)
    (commands / "pip").write_text(f"#!{commands}/python\n")
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "install.py"):
        shutil.copy(ROOT / name, folder)
    for stamp in ("installed", "demo"):
        (folder / ".venv" / stamp).touch()
    return folder


def usable(folder: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setattr(install, "VENV", folder / ".venv")
    monkeypatch.setattr(install, "PYTHON", folder / ".venv" / "bin" / "python")
    return install.usable()


def installs(folder: Path) -> list[bool]:
    """Whether `make install` and `make demo` would call install.py."""
    return [
        "install.py"
        in subprocess.check_output(["make", "--no-print-directory", "--dry-run", target], cwd=folder, text=True)
        for target in ("install", "demo")
    ]


def test_what_is_installed_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = checkout(tmp_path / "here")
    assert usable(folder, monkeypatch) and installs(folder) == [False, False]


def test_a_copied_checkout_gets_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(shutil.copytree(checkout(tmp_path / "here"), tmp_path / "copy"))
    assert not usable(folder, monkeypatch) and installs(folder) == [True, True]


def test_a_python_that_is_gone_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = checkout(tmp_path / "here")
    python = folder / ".venv" / "bin" / "python"
    python.unlink()
    python.symlink_to(tmp_path / "no-python")
    assert not usable(folder, monkeypatch) and installs(folder) == [True, True]


def test_another_version_of_python_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not usable(checkout(tmp_path / "here", OTHER), monkeypatch)
    assert not usable(tmp_path / "empty", monkeypatch)


def test_a_link_is_replaced_and_not_what_it_leads_to_and_pip_installs_for_no_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = checkout(tmp_path / "other") / ".venv"
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / ".venv").symlink_to(other)
    assert not usable(tmp_path / "here", monkeypatch)
    monkeypatch.setenv("PIP_USER", "1")
    monkeypatch.setattr(sys, "argv", ["install.py", "demo"])
    # Instead of an installation: what pip would be told.
    reported: list[str] = []

    def nothing() -> install.Installer:
        reported.append(os.environ["PIP_USER"])
        return install.Installer("none", [sys.executable, "-c", ""], "", {})

    monkeypatch.setattr(install, "HERE", tmp_path / "here")
    monkeypatch.setattr(install, "_uv", nothing)
    monkeypatch.setattr(install, "_prepare", lambda: None)
    monkeypatch.setattr(venv, "create", lambda folder, **options: folder.mkdir())
    assert install.main() == 0
    assert reported == ["0"] and (other / "bin" / "pip").exists()
    assert not (tmp_path / "here" / ".venv").is_symlink()


@pytest.mark.parametrize("code", [0, 2])
def test_uv_does_without_a_cache_where_it_cannot_write_one(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = checkout(tmp_path / "here") / ".venv" / "bin"
    # As uv 0.13 ends in each of its commands that use the cache.
    (commands / "uv").write_text(f"#!/bin/sh\nexit {code}\n")
    (commands / "uv").chmod(0o755)
    monkeypatch.setattr(install, "VENV", commands.parent)
    monkeypatch.setattr(install, "PYTHON", commands / "python")
    ran: list[list[str]] = []
    monkeypatch.setattr(install.Installer, "__init__", lambda self, name, command, option, env: ran.append(command))
    install._uv()
    assert ("--no-cache" in ran[0]) is (code == 2)
