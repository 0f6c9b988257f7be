"""The seeds of training worlds, apart from every evaluation seed."""

from __future__ import annotations

# Evaluation seeds count up from 0 and stay far below this.
FIRST_TRAINING_SEED = 1_000_000
