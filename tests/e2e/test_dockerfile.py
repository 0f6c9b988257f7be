"""What the edge's Dockerfile copies for a step is enough for that step; the rest of it is `make compose`'s to try."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_model_is_fetched_with_the_files_that_are_copied_for_it(tmp_path: Path) -> None:
    text = (ROOT / "docker" / "edge.Dockerfile").read_text()
    stage = text.split("AS model\n")[1].split("\nFROM")[0]
    for *sources, target in (line.split() for line in re.findall(r"^COPY (.+)$", stage, re.MULTILINE)):
        (tmp_path / target).mkdir(parents=True, exist_ok=True)
        for source in sources:
            if (ROOT / source).is_dir():
                shutil.copytree(ROOT / source, tmp_path / target, dirs_exist_ok=True)
            else:
                shutil.copy(ROOT / source, tmp_path / target)
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
