"""The files that import TorchRL, which takes seconds, are read only where long tests run, or where they are named."""

from __future__ import annotations

from pathlib import Path

import pytest

_WITH_TORCHRL = ("test_env.py", "test_schemes.py", "test_training.py")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Whether a file is left out; None leaves that to pytest."""
    without_long = "not long" in config.getoption("markexpr")
    return True if without_long and collection_path.name in _WITH_TORCHRL else None
