"""Where a formulation's UAVs end, as Booleans of its model."""

from __future__ import annotations

from typing import Any

import numpy as np
from ortools.sat.python import cp_model

from shared.channel import IntArray
from shared.fleetplan.afterwards import Afterwards


class Endings:
    """The stages at which the UAVs of one model end.

    The Boolean ``n_ijk`` says that UAV i ends below stage k for sensor j, and confines the UAV's last sum of velocities
    to the values for which that is so.

    Args:
        model: gets the Booleans.
        afterwards: the stages; ``None`` if the price does not depend on them.
    """

    def __init__(self, model: cp_model.CpModel, afterwards: Afterwards | None) -> None:
        self._model = model
        self._afterwards = afterwards
        self._last: list[tuple[Any, IntArray]] = []
        self._near: dict[tuple[int, int, int], Any] = {}

    def add(self, last: Any, sums: IntArray) -> None:
        """Add the next UAV's last sum of velocities: a variable or a number, and the values that it may have."""
        self._last.append((last, np.array([last]) if isinstance(last, int) else sums))

    def below(self, stage: int, sensor: int) -> list[Any] | None:
        """Booleans each of which says that a UAV ends below a stage; ``None`` if one ends there in every plan."""
        found: list[Any] = []
        if stage == 0 or self._afterwards is None:
            return found
        for uav, (last, sums) in enumerate(self._last):
            within = self._afterwards.stages[uav][sums, sensor] < stage
            if within.all():
                return None
            if within.any():
                literal = self._near[uav, sensor, stage] = self._model.new_bool_var(f"n_{uav}_{sensor}_{stage}")
                domain = cp_model.Domain.from_values(sums[within].tolist())
                self._model.add_linear_expression_in_domain(last, domain).only_enforce_if(literal)
                found.append(literal)
        return found

    def hint(self, flown: IntArray) -> None:
        """Let the search start from velocities that sum to ``(I,)``."""
        for (uav, sensor, stage), literal in self._near.items():
            assert self._afterwards is not None
            self._model.add_hint(literal, int(self._afterwards.stages[uav][flown[uav], sensor] < stage))
