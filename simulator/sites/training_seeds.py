"""The seeds of training worlds, apart from every evaluation seed."""

from __future__ import annotations

# Training worlds start here, so that no evaluation seed (from 0) is ever among them.
FIRST_TRAINING_SEED = 1_000_000
