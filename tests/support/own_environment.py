"""A virtual environment of a test's own, for packages that demand other versions than the lock has."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path
from unittest.mock import patch

import install


class OwnEnvironment:
    """The environment in a folder; ``programs`` is where its programs are."""

    def __init__(self, folder: Path) -> None:
        self.programs = folder / "bin"
        venv.create(folder, with_pip=True)
        # As the project installs: by uv where it can be had, with the machine's pip settings; but without its lock.
        with patch.multiple(install, VENV=Path(sys.prefix), PYTHON=self.programs / "python"):
            self._installer = install._uv() or install._pip()

    def install(self, *wanted: str) -> None:
        """Install packages, after options of pip."""
        subprocess.run([*self._installer._command, *wanted], check=True, env=self._installer._environment)
