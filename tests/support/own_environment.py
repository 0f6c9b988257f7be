"""A separate virtual environment of a test, for packages that require other versions than the lock's."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path
from unittest.mock import patch

import install


class OwnEnvironment:
    """The environment in a folder; ``programs`` is the folder of its programs."""

    def __init__(self, folder: Path) -> None:
        self.programs = folder / "bin"
        venv.create(folder, with_pip=True)
        # Install as the project does, by uv if available and with the machine's pip settings, but without the lock.
        with patch.multiple(install, VENV=Path(sys.prefix), PYTHON=self.programs / "python"):
            self._installer = install._uv() or install._pip()

    def install(self, *packages: str) -> None:
        """Install packages; options of pip come first."""
        subprocess.run([*self._installer._command, *packages], check=True, env=self._installer._environment)
