"""One decision in the making: a UAV's augmented state, and what the attention module made of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from service.guidance.step_guidance import StepGuidance
from service.learning.attention import top_k
from service.learning.sample import Sample
from service.mission.events import Pending
from service.mission.mission import Mission
from service.prompting.row_formats import cells
from shared.actions import Action
from shared.features import State, augment
from shared.wire import Candidate, UavState

_NO_FEATURES = np.empty((0, 0), np.float32)
_NO_CONTEXTS = torch.empty(0)


@dataclass(slots=True)
class AttendedState:
    """A UAV's view at one step. ``rows`` index the state's arrays: the k sensors kept, best first.

    Without attention ``rows`` are all that is admissible, in the request's order. ``asked`` is what the operator's
    guidance asks of this step, if it asks for anything.
    """

    uav_id: int
    step: int
    state: State
    asked: StepGuidance | None = None
    rows: list[int] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    _admissible: list[int] = field(default_factory=list)
    _features: NDArray[np.float32] = field(default_factory=lambda: _NO_FEATURES)
    _contexts: Tensor = field(default_factory=lambda: _NO_CONTEXTS)

    @classmethod
    def of(cls, mission: Mission, uav: UavState, step: int) -> Self:
        """Augment what the UAV reported with what its mission knows."""
        state = augment(
            uav,
            step,
            mission.scenario,
            visits=mission.visits,
            rates=mission.rates,
            reserved=mission.reserved(step, uav.uav_id),
            preset=mission.features,
            belief=mission.belief if mission.decides_from == "fleet" else None,
        )
        guidance, scenario = mission.guidance.obeyed, mission.scenario
        asked = StepGuidance.of(guidance, state, step, mission.visits, uav.uav_id, scenario)
        return cls(uav_id=uav.uav_id, step=step, state=state, asked=asked)

    @property
    def offered(self) -> list[int]:
        """IDs of the sensors kept, in the order of ``rows``."""
        return [candidate.sensor_id for candidate in self.candidates]

    def attend(self, mission: Mission) -> None:
        """Score the admissible sensors and keep the mission's top k, or all of them where it goes without attention."""
        self._admissible = np.flatnonzero(self.state.admissible).tolist()
        self._features = self.state.features(mission.scenario)
        if not self._admissible:
            return
        scores, self._contexts = mission.learner.score(self._features)
        if self.asked is not None:
            # A score is minus a cost, and what counts in a cost are packets / W.
            added = self.asked.worth[:, self._admissible].max(axis=0) / mission.scenario.queue_capacity
            scores = scores + torch.from_numpy(added.astype(np.float32))
        kept = top_k(scores, mission.top_k) if mission.attends else list(range(len(self._admissible)))
        self.rows = [self._admissible[i] for i in kept]
        ids, told = self.state.ids[self.rows].tolist(), scores.tolist()
        self.candidates = [
            Candidate(sensor_id=sensor, score=round(told[i], 6)) for sensor, i in zip(ids, kept, strict=True)
        ]

    def shown(self, mission: Mission) -> list[int]:
        """``rows`` in the order of the prompt: as they are, or shuffled by the mission's seed, the step and the UAV."""
        if mission.spec.prompt.order == "score":
            return self.rows
        shuffle = np.random.default_rng([mission.spec.seed, self.step, self.uav_id])
        return [self.rows[i] for i in shuffle.permutation(len(self.rows))]

    def nearest(self, mission: Mission) -> list[str]:
        """Past decisions most like the rows kept, for the prompt's last block, as the mission's selection has it."""
        if not self.rows:
            return []
        return mission.memory.nearest(self._features[[self._admissible.index(row) for row in self.rows]])

    def by_value(self, mission: Mission) -> Action:
        """The best-scored sensor and the best velocity for it that is allowed, by the learned values."""
        row = self.rows[0]
        approach = self.state.approach(row, mission.scenario)
        values = mission.learner.velocities(self._contexts[self._admissible.index(row)], approach)
        level = int(values.argmax())
        if self.asked is not None:
            level = self.asked.nearest(row, level)
        return Action(int(self.state.ids[row]), level)

    def values(self, mission: Mission) -> dict[int, NDArray[np.float32]]:
        """What the modules think of the sensors kept: by ID ``s_j + u_jv - max_v u_jv`` at each velocity level v."""
        found = {}
        for row, candidate in zip(self.rows, self.candidates, strict=True):
            approach = self.state.approach(row, mission.scenario)
            levels = mission.learner.velocities(self._contexts[self._admissible.index(row)], approach).numpy()
            found[candidate.sensor_id] = candidate.score + levels - levels.max()
        return found

    def pending(self, mission: Mission, decision_id: str, sensor_id: int, velocity: int) -> Pending:
        """The decision, as its outcome will need it."""
        rows = np.flatnonzero(self.state.ids == sensor_id)
        row = int(rows[0]) if len(rows) else None
        sample = None
        if row is not None and row in self._admissible:
            sample = Sample(
                features=self._features,
                chosen=self._admissible.index(row),
                approach=self.state.approach(row, mission.scenario),
                velocity=velocity,
            )
        return Pending(
            decision_id=decision_id,
            uav_id=self.uav_id,
            step=self.step,
            sensor_id=sensor_id,
            velocity=velocity,
            seen=mission.template.unknown(sensor_id) if row is None else cells(self.state, [row])[0],
            sample=sample,
        )
