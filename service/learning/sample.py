"""A training sample: a decision as the modules saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sample:
    """One decision as the modules saw it.

    ``features`` are the admissible sensors' ``(n, d)``, ``chosen`` the row that was decided for, ``approach``
    what the velocity scorer was told of that sensor (see :meth:`State.approach`), ``velocity`` the level flown.
    """

    features: Array
    chosen: int
    approach: Array
    velocity: int
