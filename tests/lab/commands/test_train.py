"""`python -m lab train` without its extra."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from simulator.errors import UsageError


@pytest.mark.usefixtures("without_extra")
def test_without_torch_training_names_the_extra(tmp_path: Path) -> None:
    from lab.commands.train import Train, train

    with pytest.raises(UsageError, match=r"torch is not installed. Install the extra: pip install -e '.\[lab\]'"):
        train(Train(scheme="madqn", out=tmp_path), "python -m lab train madqn", Console())
