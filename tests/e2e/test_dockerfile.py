"""The files and the extras that a Dockerfile names are enough for the commands which its image runs.

No engine is needed: the tests copy what the Dockerfile copies, and run its commands in an interpreter that sees these
files and the distributions of its extras alone. `make compose` builds the images themselves.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tests.support.places import ROOT

SITE = sysconfig.get_path("purelib")

# `-S` leaves the .pth files of site-packages unread. One of them is the editable installation of this checkout, which
# would serve every module that a folder lacks.
_AICVDS = """#!{python} -S
import importlib.metadata, sys
sys.path[:0] = [{folder!r}, {site!r}]
sys.path.remove({bin!r})
from packaging.requirements import Requirement

def installed(name, extras):
    # The distribution and all that it requires with these extras.
    found, todo = set(), [(name, extra) for extra in ("", *extras)]
    while todo:
        name, extra = todo.pop()
        key = (name.lower().replace("_", "-"), extra)
        if key in found:
            continue
        found.add(key)
        try:
            lines = importlib.metadata.requires(name) or ()
        except importlib.metadata.PackageNotFoundError:
            continue
        for requirement in map(Requirement, lines):
            if requirement.marker is None or requirement.marker.evaluate({{"extra": extra}}):
                todo += [(requirement.name, wanted) for wanted in ("", *requirement.extras)]
    return {{name for name, _ in found}}

class Absent:
    # Modules of this environment that the image does not have.
    def __init__(self, extras):
        present = installed("aic-vds", extras)
        self.modules = {{
            module
            for module, distributions in importlib.metadata.packages_distributions().items()
            if not present & {{name.lower().replace("_", "-") for name in distributions}}
        }}

    def find_spec(self, name, path=None, target=None):
        if path is None and name in self.modules:
            raise ModuleNotFoundError(f"the image has no module {{name!r}}", name=name)

sys.meta_path.insert(0, Absent({extras!r}))
from shared.kit.command_line import main
sys.exit(main())
"""


def stage_of(image: str, name: str) -> str:
    """The text of one stage of an image's Dockerfile."""
    text = (ROOT / "docker" / f"{image}.Dockerfile").read_text()
    return re.split(r"^FROM ", text.split(f"AS {name}\n")[1], maxsplit=1, flags=re.MULTILINE)[0]


def copy(stage: str, folder: Path) -> None:
    """Put what a stage copies from the checkout into a folder."""
    for *sources, target in (line.split() for line in re.findall(r"^COPY (?!--from)(.+)$", stage, re.MULTILINE)):
        (folder / target).mkdir(parents=True, exist_ok=True)
        for source in sources:
            if (ROOT / source).is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(ROOT / source, folder / target, dirs_exist_ok=True, ignore=ignored)
            else:
                shutil.copy(ROOT / source, folder / target)


def fetch_model(folder: Path) -> subprocess.CompletedProcess[str]:
    """`aicvds model fetch` by the modules in this folder and by no others."""
    return subprocess.run(
        [sys.executable, "-S", "-m", "shared.kit.command_line", "model", "fetch"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(folder), SITE))},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def build(image: str, folder: Path, version: str) -> Path:
    """The wheel that the image's stage `application` builds."""
    stage = stage_of(image, "application")
    assert 'ARG VERSION=""\n' in stage
    if not (folder / "pyproject.toml").exists():
        copy(stage, folder)
        shutil.copy(ROOT / "pyproject.toml", folder)
    (command,) = re.findall(r"^RUN (.+)$", stage, re.MULTILINE)
    wheels = folder / f"wheels-{version}"
    env = os.environ | {
        "VERSION": version,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        # pip reads 0 as "no isolation": the build needs no environment of its own, hence no package index.
        "PIP_NO_BUILD_ISOLATION": "0",
    }
    subprocess.run(["sh", "-c", command.replace("/wheels", str(wheels))], cwd=folder, env=env, check=True)
    # The files that a build leaves tell the next build the version.
    shutil.rmtree(folder / "aic_vds.egg-info")
    (wheel,) = wheels.iterdir()
    return wheel


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """By image: a folder with an ``aicvds`` that sees its wheel and the distributions of its extras alone."""
    return cache(lambda image: install(image, tmp_path_factory.mktemp(image)))


def install(image: str, tmp_path: Path) -> Path:
    source, folder, commands = tmp_path / "source", tmp_path / "site", tmp_path / "bin"
    source.mkdir()
    zipfile.ZipFile(build(image, source, "1.2.3")).extractall(folder)
    commands.mkdir()
    (extras,) = re.findall(r"'\.\[([\w,]+)\]'", stage_of(image, "dependencies"))
    script = _AICVDS.format(
        python=sys.executable, folder=str(folder), site=SITE, bin=str(commands), extras=extras.split(",")
    )
    (commands / "aicvds").write_text(script)
    (commands / "aicvds").chmod(0o755)
    return commands


def test_the_model_is_fetched_with_the_files_that_are_copied_for_it(tmp_path: Path) -> None:
    copy(stage_of("edge", "model"), tmp_path)
    ran = fetch_model(tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert "vocabulary" in ran.stdout + ran.stderr


def test_every_file_that_is_copied_for_the_model_is_needed(tmp_path: Path) -> None:
    # So the test above fails for any file that the Dockerfile leaves out.
    stage = stage_of("edge", "model")
    files = [word for word in re.findall(r"\S+\.py\b", stage) if not word.endswith("__init__.py")]
    assert len(files) >= 2
    for left_out in files:
        folder = tmp_path / left_out.replace("/", "-")
        copy(stage, folder)
        (folder / left_out).unlink()
        ran = fetch_model(folder)
        module = left_out.removesuffix(".py").replace("/", ".")
        assert ran.returncode != 0 and f"No module named '{module}'" in ran.stderr, ran.stdout + ran.stderr


@pytest.mark.parametrize("image", ["edge", "simulator"])
def test_an_images_user_can_read_what_is_copied_under_any_umask(image: str) -> None:
    final = (ROOT / "docker" / f"{image}.Dockerfile").read_text().rpartition("\nFROM ")[2]
    before, _, after = final.partition("USER ")
    copied = re.findall(r"^COPY (?!--from)(\S+) (\S+/)$", before, re.MULTILINE)
    assert "\nCOPY" not in after and before.count("\nCOPY") == len(copied) + before.count("\nCOPY --from")
    assert [f"RUN chmod 644 {folder}{Path(file).name}\n" in before for file, folder in copied] == [True] * len(copied)


@pytest.mark.long
@pytest.mark.parametrize(
    ("image", "package", "version", "built"),
    [("edge", "service", "1.2.3", "1.2.3"), ("simulator", "simulator", "", "0.1.0.dev0")],
)
def test_the_wheel_of_an_image_holds_everything_and_the_version_that_it_was_given(
    image: str, package: str, version: str, built: str, tmp_path: Path
) -> None:
    wheel = build(image, tmp_path, version)
    assert wheel.name.startswith(f"aic_vds-{built}-")
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    # The wheel may hold untracked files of this checkout too.
    tracked = subprocess.check_output(["git", "ls-files", package, "shared"], cwd=ROOT, text=True).splitlines()
    assert tracked and packed >= set(tracked)


@pytest.mark.long
@pytest.mark.parametrize("image", ["edge", "simulator"])
def test_an_images_own_check_passes_with_its_files_and_its_extras_alone(
    image: str, installed: Callable[[str], Path], tmp_path: Path
) -> None:
    commands = installed(image)
    text = (ROOT / "docker" / f"{image}.Dockerfile").read_text()
    (check,) = re.findall(r"^RUN (python /opt/aicvds/check_edge\.py|aicvds simulate .*)$", text, re.MULTILINE)
    check = check.replace("/opt/aicvds", str(ROOT / "docker")).replace("/tmp/check", str(tmp_path / "check"))
    path = os.pathsep.join((str(commands), str(Path(sys.executable).parent), os.environ["PATH"]))
    env = {**os.environ, "PATH": path, "TMPDIR": str(tmp_path)}
    ran = subprocess.run(["sh", "-c", check], cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.mark.long
def test_a_module_of_an_extra_that_an_image_does_not_install_is_missing_in_it(
    installed: Callable[[str], Path],
) -> None:
    # So the checks above see a module that an image lacks. The simulator's image has no OR-Tools.
    commands = installed("simulator")
    ran = subprocess.run([commands / "aicvds", "bound", "--seed", "0"], capture_output=True, text=True, check=False)
    assert ran.returncode != 0 and "the image has no module 'ortools" in ran.stderr, ran.stderr + ran.stdout
