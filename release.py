"""``make release``: builds wheel, sdist, SBOM and checksums into dist/, and both Docker images.

The version comes from git: from the tag v1.2.3 on this commit, otherwise it is a development version.
CONTRIBUTING.md says how to cut one.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

import tyro
from packaging.metadata import parse_email
from packaging.version import Version
from rich.console import Console

ROOT = Path(__file__).parent
DIST = ROOT / "dist"
PACKAGES = ("service", "shared", "simulator", "field")
IMAGES = ("edge", "simulator")
# Extras for work on this repository, which users do not need.
OWN_EXTRAS = {"dev", "docs", "lab", "release"}

console = Console(stderr=True, highlight=False)


class NotReleased(Exception):
    """The release is refused; the text says why, and what to do."""


@dataclass(frozen=True)
class Release:
    """Build wheel, sdist, SBOM and checksums into dist/, and both Docker images, of the commit that is checked out.

    The wheel is tried in a clean virtual environment, where the edge decides in every mode and a mission is flown.
    SHA256SUMS is written last: a dist/ without it is not complete.

    Exit code: 0 built, 1 not.
    """

    images: Literal["auto", "required", "none"] = "auto"
    """Docker images: without an engine `auto` skips them and `required` fails; `none` builds none."""
    build_network: Annotated[str, tyro.conf.arg(metavar="NAME")] = "default"
    """Network of the images' builds; `host` if they reach the package index only from the machine's own network."""


def main() -> int:
    """Release the commit that is checked out; returns the exit code."""
    options = tyro.cli(Release, prog="release.py")
    try:
        version = version_to_release(ROOT)
        names = IMAGES if images_wanted(options.images) else ()
        release(version, options, names)
    except NotReleased as reason:
        console.print(f"make release: {reason}", markup=False, soft_wrap=True)
        return 1
    except subprocess.CalledProcessError as failed:
        command = shlex.join(map(str, failed.cmd))
        console.print(f"make release: exit code {failed.returncode} of {command}", markup=False, soft_wrap=True)
        return 1
    return 0


def version_to_release(root: Path) -> str:
    """The version of the commit that is checked out in ``root``.

    Raises:
        NotReleased: there is no git repository, there are uncommitted changes, or the changelog has no section for
            the version; a development version needs none.
    """
    if not (root / ".git").exists():
        raise NotReleased("this is no clone of the git repository, and the version comes from git")
    if changed := output("git", "status", "--porcelain", cwd=root).rstrip("\n"):
        raise NotReleased(f"commit, stash or delete these changes first:\n{changed}")
    version = output(sys.executable, "-m", "setuptools_scm", cwd=root).strip()
    if Version(version).is_devrelease:
        console.print(f"{version} is a development version: no tag such as v1.2.3 is on this commit", soft_wrap=True)
        return version
    section = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$"
    if not re.search(section, (root / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE):
        raise NotReleased(
            f"CHANGELOG.md has no section `## [{version}] - YYYY-MM-DD`: commit it, and move the tag there"
        )
    return version


def images_wanted(asked: Literal["auto", "required", "none"]) -> bool:
    """Whether to build images; raises ``NotReleased`` if they are required and no engine answers."""
    if asked == "none":
        console.print("The Docker images are left out, as IMAGES=none says")
        return False
    answers = shutil.which("docker") is not None and succeeds("docker", "info")
    if asked == "required" and not answers:
        raise NotReleased("IMAGES=required, and no Docker engine answers")
    if not answers:
        console.print("The Docker images are left out: no Docker engine answers")
    return answers


def release(version: str, options: Release, images: Sequence[str]) -> None:
    """Build, try and list everything; raises ``CalledProcessError`` or ``NotReleased`` if a step fails."""
    shutil.rmtree(DIST, ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # A clone has only committed files.
        source = folder / "source"
        run("git", "clone", "--quiet", ROOT, source)
        step(f"wheel and sdist of {version}")
        wheel = build_wheel(source)
        check_contents(wheel, source)
        step("the wheel in a clean environment")
        python = clean_environment(wheel, folder)
        try_installed(version, python, folder)
        step("SBOM")
        write_sbom(version, python, wheel.with_name(f"aic_vds-{version}.cdx.json"))
        tags = [build_image(image, version, source, options) for image in images]
    files = sorted(DIST.iterdir())
    sums = (f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files)
    (DIST / "SHA256SUMS").write_text("".join(sums), encoding="utf-8")
    step(f"{version} is built")
    console.print(*(f"dist/{path.name}" for path in files), "dist/SHA256SUMS", *tags, sep="\n", soft_wrap=True)


def build_wheel(source: Path) -> Path:
    """Build the sdist, and the wheel from it, with the pinned tools of this environment; returns the wheel."""
    # With the commit's time in the archives the same commit gives the same wheel.
    seconds = output("git", "log", "-1", "--format=%ct", cwd=source).strip()
    run(sys.executable, "-m", "build", "--quiet", "--no-isolation", "--outdir", DIST, source, SOURCE_DATE_EPOCH=seconds)
    (wheel,) = DIST.glob("*.whl")
    return wheel


def check_contents(wheel: Path, source: Path) -> None:
    """Raise ``NotReleased`` if the packages' files in the wheel are not those in git."""
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if name.split("/")[0] in PACKAGES}
    tracked = set(output("git", "ls-files", *PACKAGES, cwd=source).splitlines())
    if packed != tracked:
        raise NotReleased(f"the wheel and git differ, see package-data in pyproject.toml: {sorted(packed ^ tracked)}")


def clean_environment(wheel: Path, folder: Path) -> Path:
    """Install the wheel with all users' extras into a new virtual environment; returns its Python."""
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        extras = set(parse_email(archive.read(metadata))[0]["provides_extra"]) - OWN_EXTRAS
    constraints = ROOT / "constraints.txt"
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv")
    python = folder / "venv" / "bin" / "python"
    install = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet")
    run(*install, "--constraint", constraints, f"aic-vds[{','.join(sorted(extras))}] @ {wheel.as_uri()}")
    return python


def try_installed(version: str, python: Path, folder: Path) -> None:
    """Let the installed edge decide in every mode and the simulator fly, as in the images."""
    settings = ("AICVDS_", "OTEL_", "PYTHON")
    env = {name: value for name, value in os.environ.items() if not name.startswith(settings)}
    env |= {name: os.environ[name] for name in ("AICVDS_CACHE_DIR",) if name in os.environ}
    env |= {"AICVDS_LOG_LEVEL": "warning", "PATH": f"{python.parent}:{env['PATH']}"}

    def installed(*command: str | Path) -> str:
        return subprocess.run(command, cwd=folder, env=env, check=True, stdout=subprocess.PIPE, text=True).stdout

    expect_version(installed("aicvds", "--version"), version)
    installed(python, ROOT / "docker" / "check_edge.py")
    installed("aicvds", "simulate", "--policy", "eof", "--out", folder / "mission")


def write_sbom(version: str, python: Path, path: Path) -> None:
    """List the packages installed for that Python, as CycloneDX JSON."""
    sbom = (sys.executable, "-m", "cyclonedx_py", "environment", "--pyproject", ROOT / "pyproject.toml")
    run(*sbom, "--output-reproducible", "--output-format", "JSON", "--output-file", path, python)
    # pyproject.toml has no version.
    bom = json.loads(path.read_text(encoding="utf-8"))
    bom["metadata"]["component"] |= {"version": version, "purl": f"pkg:pypi/aic-vds@{quote(version)}"}
    path.write_text(json.dumps(bom, indent=2) + "\n", encoding="utf-8")


def build_image(name: str, version: str, source: Path, options: Release) -> str:
    """Build the image of the edge or of the simulator; returns its name and tag."""
    # The tag of an image cannot have a `+`.
    image = f"aicvds-{name}:{version.replace('+', '-')}"
    step(f"image {image}")
    labels = {"version": version, "revision": output("git", "rev-parse", "HEAD", cwd=source).strip()}
    arguments = {"VERSION": version}
    command = ["docker", "build", "--file", str(source / "docker" / f"{name}.Dockerfile"), "--tag", image]
    command += ["--network", options.build_network]
    command += [f"--build-arg={key}={value}" for key, value in arguments.items()]
    command += [f"--label=org.opencontainers.image.{key}={value}" for key, value in labels.items()]
    # Without the buildx plug-in Docker has only the classic builder.
    buildkit = "1" if succeeds("docker", "buildx", "version") else "0"
    run(*command, source, DOCKER_BUILDKIT=buildkit)
    expect_version(output("docker", "run", "--rm", "--network=none", image, "aicvds", "--version"), version)
    return image


def expect_version(said: str, version: str) -> None:
    """Raise ``NotReleased`` unless ``said`` is the output of ``aicvds --version`` for this version."""
    if said.strip() != f"aicvds {version}":
        raise NotReleased(f"`aicvds --version` says {said.strip()!r}, and {version} is released")


def step(what: str) -> None:
    """Print the heading of a step."""
    console.rule(what, align="left")


def run(*command: str | Path, **env: str) -> None:
    """Run a command with visible output."""
    subprocess.run(command, cwd=ROOT, env={**os.environ, **env}, check=True)


def output(*command: str | Path, cwd: Path = ROOT) -> str:
    """The output of a command."""
    return subprocess.run(command, cwd=cwd, check=True, stdout=subprocess.PIPE, text=True).stdout


def succeeds(*command: str) -> bool:
    """Whether a command, without its output, ends with code 0."""
    return subprocess.run(command, check=False, capture_output=True).returncode == 0


if __name__ == "__main__":
    sys.exit(main())
