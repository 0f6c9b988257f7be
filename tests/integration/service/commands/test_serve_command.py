"""`aicvds serve` before the service itself is imported."""

from __future__ import annotations

import subprocess
import sys

import pytest

_STARTED = """
import os, sys
from service.commands import serve
assert serve.main(["--port", "99999"]) == 2
print(os.environ["GOMP_SPINCOUNT"], "torch" in sys.modules)
"""


@pytest.mark.parametrize(("given", "expected"), [(None, "1000"), ("7", "7")])
def test_openmp_threads_spin_little_by_a_variable_set_before_torch_is_imported(
    given: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    if given is not None:
        monkeypatch.setenv("GOMP_SPINCOUNT", given)
    done = subprocess.run([sys.executable, "-c", _STARTED], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [expected, "False"]
