"""What the Dockerfiles copy for a step is enough for that step; the rest of them is `make compose`'s to try."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def stage_of(image: str, name: str, folder: Path) -> str:
    """A stage's text; what it copies, and what the stage before all others does, is put into the folder."""
    text = (ROOT / "docker" / f"{image}.Dockerfile").read_text()
    stage = text.split(f"AS {name}\n")[1].split("\nFROM")[0]
    for *sources, target in (line.split() for line in re.findall(r"^COPY (.+)$", stage, re.MULTILINE)):
        (folder / target).mkdir(parents=True, exist_ok=True)
        for source in sources:
            if (ROOT / source).is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(ROOT / source, folder / target, dirs_exist_ok=True, ignore=ignored)
            else:
                shutil.copy(ROOT / source, folder / target)
    return stage


def test_the_model_is_fetched_with_the_files_that_are_copied_for_it(tmp_path: Path) -> None:
    stage_of("edge", "model", tmp_path)
    ran = subprocess.run(
        [sys.executable, "-m", "shared.cli", "model", "fetch"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "vocabulary" in ran.stdout + ran.stderr


@pytest.mark.parametrize(("image", "package"), [("edge", "service"), ("simulator", "simulator")])
def test_the_wheel_of_an_image_holds_everything_and_the_version_that_it_was_given(
    image: str, package: str, tmp_path: Path
) -> None:
    stage = stage_of(image, "application", tmp_path)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (command,) = re.findall(r"^RUN (.+)$", stage, re.MULTILINE)
    assert 'ARG VERSION=""\n' in stage
    for version, built in (("1.2.3", "1.2.3"), ("", "0.1.0.dev0")):
        wheels = tmp_path / f"wheels-{built}"
        env = os.environ | {
            "VERSION": version,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            # pip reads it so: no environment of the build's own, hence no package index.
            "PIP_NO_BUILD_ISOLATION": "0",
        }
        subprocess.run(["sh", "-c", command.replace("/wheels", str(wheels))], cwd=tmp_path, env=env, check=True)
        # What this build leaves tells the next one the version.
        shutil.rmtree(tmp_path / "aic_vds.egg-info")
        (wheel,) = wheels.iterdir()
        assert wheel.name.startswith(f"aic_vds-{built}-")
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    # Of what lies about beside that, nobody claims anything.
    tracked = subprocess.check_output(["git", "ls-files", package, "shared"], cwd=ROOT, text=True).splitlines()
    assert tracked and packed >= set(tracked)
