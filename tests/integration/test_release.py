"""What `make release` refuses, and which version it finds. It tries the rest itself, whenever something is released."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from release import NotReleased, check_contents, images_wanted, version_to_release
from tests.support.places import ROOT

SECTION = "## [1.2.3] - 2026-11-30\n"
Git = Callable[..., None]


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A repository with one commit, whose changelog knows 1.2.3."""
    for name in ("pyproject.toml", "release.py", ".gitignore"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n## [Unreleased]\n\n{SECTION}")
    package = tmp_path / "service"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "data.json").touch()
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", "--all")
    commit(tmp_path)
    return tmp_path


def git(clone: Path, *words: str) -> None:
    who = ("-c", "user.name=test", "-c", "user.email=test@localhost")
    subprocess.run(["git", *who, *words], cwd=clone, check=True)


def commit(clone: Path) -> None:
    git(clone, "commit", "--quiet", "--all", "--allow-empty", "--message=test")


def test_a_commit_without_a_tag_is_a_development_version(clone: Path) -> None:
    assert version_to_release(clone).startswith("0.1.0.dev1+g")
    git(clone, "tag", "v1.2.3")
    commit(clone)
    assert version_to_release(clone).startswith("1.2.4.dev1+g")


def test_a_tag_is_a_version_once_the_changelog_has_it(clone: Path) -> None:
    git(clone, "tag", "v1.2.3")
    assert version_to_release(clone) == "1.2.3"
    (clone / "CHANGELOG.md").write_text("# Changelog\n\n## [Unreleased]\n\n## [11.2.3] - 2026-11-30\n")
    commit(clone)
    git(clone, "tag", "--force", "v1.2.3")
    with pytest.raises(NotReleased, match=r"no section `## \[1\.2\.3\] - YYYY-MM-DD`"):
        version_to_release(clone)


@pytest.mark.parametrize("name", ["release.py", "service/new.py"])
def test_what_is_not_committed_is_not_released(clone: Path, name: str) -> None:
    with (clone / name).open("a") as file:
        file.write("\n")
    ended = subprocess.run(
        [sys.executable, clone / "release.py"], cwd=clone, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert "make release: commit, stash or delete" in ended.stderr and name in ended.stderr
    assert not (clone / "dist").exists()


def test_ignored_files_are_nobodys_concern(clone: Path) -> None:
    (clone / "dist").mkdir()
    (clone / "dist" / "old.whl").touch()
    assert version_to_release(clone)


def test_a_folder_without_git_is_told_so(tmp_path: Path) -> None:
    with pytest.raises(NotReleased, match="no clone"):
        version_to_release(tmp_path)


def test_images_are_left_out_without_an_engine_unless_they_must_be_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not images_wanted("auto")
    assert not images_wanted("none")
    with pytest.raises(NotReleased, match="no Docker engine answers"):
        images_wanted("required")


@pytest.mark.parametrize(
    ("packed", "named"), [(["__init__.py"], "data.json"), (["__init__.py", "data.json", "x"], "x")]
)
def test_a_wheel_holds_what_git_has_of_the_packages(clone: Path, packed: list[str], named: str) -> None:
    wheel = clone / "made.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in packed:
            archive.writestr(f"service/{name}", "")
    with pytest.raises(NotReleased, match=rf"\['service/{named}'\]"):
        check_contents(wheel, clone)


def test_the_changelog_says_what_is_not_released_yet() -> None:
    assert "\n## [Unreleased]\n" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
