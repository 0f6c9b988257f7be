"""Install AIC-VDS from this checkout into .venv, by uv where it can be had and by pip elsewhere.

    python install.py demo      what `make demo` needs
    python install.py all       everything: tests, laboratory, documentation

Both follow constraints.txt, and the machine's pip settings: indexes, find-links, constraints, certificates. Only the
laboratory needs torch: on a machine with the whole internet, --torch-index is the address of PyTorch's CPU index.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
import venv
from collections.abc import Iterator, Mapping
from pathlib import Path

HERE = Path(__file__).resolve().parent
VENV = HERE / ".venv"
PYTHON = VENV / "bin" / "python"
CONSTRAINTS = HERE / "constraints.txt"
EXTRAS = {"demo": "demo", "all": "dev"}


def main() -> int:
    """Install; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=EXTRAS, help="demo: what `make demo` needs; all: everything")
    parser.add_argument("--torch-index", default="", help="install torch from this index")
    parser.add_argument("--pip", action="store_true", help="install by pip, even where uv could be had")
    args = parser.parse_args()
    # What it installs is for .venv alone, whatever pip's settings say: `user = true` would end the installation.
    os.environ["PIP_USER"] = "0"
    began = time.monotonic()
    try:
        if not usable():
            # What a link leads to may be another checkout's.
            if VENV.is_symlink():
                VENV.unlink()
            venv.create(VENV, with_pip=True, symlinks=True, clear=True)
        installer = _pip() if args.pip else _uv() or _pip()
        print(f"Installing {args.what} into {VENV.name} by {installer.name}", flush=True)
        if args.torch_index:
            torch = next(line for line in CONSTRAINTS.read_text().splitlines() if line.startswith("torch=="))
            installer.install([torch], default_index=args.torch_index)
        # Commands that run from here would take the entry points of an earlier installation out of its egg-info.
        for stale in HERE.glob("*.egg-info"):
            shutil.rmtree(stale)
        installer.install(["--editable", f"{HERE}[{EXTRAS[args.what]}]"])
        _prepare()
    except subprocess.CalledProcessError as failed:
        print(f"install.py: {failed.cmd[0]} ended with exit code {failed.returncode}; see above", file=sys.stderr)
        return 1
    print(f"Installed in {time.monotonic() - began:.0f} s", flush=True)
    return 0


def usable() -> bool:
    """Whether .venv is of this folder and of this version of Python: no copy of another checkout's, and with pip."""
    script = "import pip, sys; print(sys.version_info[:2], sys.prefix)"
    try:
        found = subprocess.run([PYTHON, "-c", script], capture_output=True, text=True, check=False).stdout.strip()
        # Its first lines name the interpreter that runs it.
        pip = (VENV / "bin" / "pip").read_text()
    except OSError:
        return False
    return found == f"{sys.version_info[:2]} {VENV}" and f"{VENV / 'bin'}/" in pip


def _prepare() -> None:
    """Fetch the model and compile the loops, at the same time; raises ``CalledProcessError``."""
    compiling = [str(PYTHON), "-c", "from service.edge.compilation import compile_all; compile_all()"]
    with subprocess.Popen(compiling) as compiler:
        subprocess.run([VENV / "bin" / "aicvds", "model", "fetch"], check=True)
    if compiler.returncode:
        raise subprocess.CalledProcessError(compiler.returncode, compiling)


class Installer:
    """A program that installs packages into .venv.

    Args:
        name: of the program.
        command: how to begin its command line.
        index_option: its option for the index that replaces the default one.
        environment: variables that it needs.
    """

    def __init__(self, name: str, command: list[str], index_option: str, environment: Mapping[str, str]) -> None:
        self.name = name
        self._command = command
        self._index_option = index_option
        self._environment = {**os.environ, **environment}

    def install(self, wanted: list[str], default_index: str = "") -> None:
        """Install requirements; raises ``CalledProcessError``."""
        index = [self._index_option, default_index] if default_index else []
        command = [*self._command, "--constraint", str(CONSTRAINTS), *index, *wanted]
        subprocess.run(command, check=True, env=self._environment, cwd=HERE)


def _pip() -> Installer:
    return Installer("pip", [str(PYTHON), "-m", "pip", "install", "--quiet"], "--index-url", {})


def _uv() -> Installer | None:
    """uv with pip's settings, which it does not read by itself; None where it cannot be installed."""
    uv = VENV / "bin" / "uv"
    if not uv.exists():
        pinned = next(line for line in CONSTRAINTS.read_text().splitlines() if line.startswith("uv=="))
        found = subprocess.run([PYTHON, "-m", "pip", "install", "--quiet", pinned], capture_output=True, text=True)
        if found.returncode or not uv.exists():
            return None
    settings = pip_settings()
    # As pip does: the best version of all indexes, not the first index that has the package.
    command = [str(uv), "pip", "install", "--quiet", "--python", str(PYTHON), "--index-strategy", "unsafe-best-match"]
    # It ends where its cache cannot be written, as in a home that is read-only or not there; pip goes on.
    if subprocess.run([uv, "pip", "list", "--python", PYTHON], capture_output=True, check=False).returncode:
        command.append("--no-cache")
    options = {
        "extra-index-url": "--index",
        "find-links": "--find-links",
        "constraint": "--constraint",
        "trusted-host": "--allow-insecure-host",
    }
    for setting, option in options.items():
        for value in settings.get(setting, []):
            command += [option, value]
    if settings.get("no-index", ["false"])[-1].lower() in ("1", "true", "yes", "on"):
        command.append("--no-index")
    environment = {}
    if indexes := settings.get("index-url"):
        # No option, of which a second one would be an error.
        environment["UV_DEFAULT_INDEX"] = indexes[-1]
    if proxies := settings.get("proxy"):
        environment["HTTP_PROXY"] = environment["HTTPS_PROXY"] = proxies[-1]
    if certificates := settings.get("cert"):
        environment["SSL_CERT_FILE"] = certificates[-1]
    if timeout := settings.get("timeout") or settings.get("default-timeout"):
        environment["UV_HTTP_TIMEOUT"] = timeout[-1]
    return Installer("uv", command, "--default-index", environment)


def pip_settings() -> dict[str, list[str]]:
    """The values of pip's settings, of its files and of the environment, by their names without a section."""
    listed = subprocess.run([PYTHON, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True)
    settings: dict[str, list[str]] = {}
    for name, value in _assignments(listed.stdout):
        known = settings.setdefault(name, [])
        known += [one for one in value.split() if one not in known]
    return settings


def _assignments(text: str) -> Iterator[tuple[str, str]]:
    """The settings' names and values in the output of ``pip config list``: ``global.index-url='…'``."""
    for line in text.splitlines():
        name, separator, value = line.partition("=")
        if separator:
            yield name.rpartition(".")[2], value.strip("'\"").replace("\\n", " ")


if __name__ == "__main__":
    sys.exit(main())
