"""Pruning on board: a UAV scores the sensors by its mission's attention, in numpy alone, and reports the k best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from shared.features import FEATURES, State, augment
from shared.fleetplan import FleetBelief
from shared.missions import MissionAttention, MissionStatus
from shared.records import Records, take_report
from shared.scenario import Scenario
from shared.wire import DecideResponse, Outcome, UavState
from simulator.client.report_encoders import Fetch, FullReports, Told, unplaced

# Steps until a UAV asks whether its weights are still the mission's.
REFRESH_STEPS = 10
# Queries that are weighed at once: of 10,000 sensors all would be a matrix of 400 MB.
_BLOCK = 256

FloatMatrix = NDArray[np.float32]


@dataclass(frozen=True)
class Attention:
    """``W_q``, ``W_k``, ``W_v`` ``(d', d)``, and the score's ``w`` ``(1, d')`` and ``b`` ``(1,)``."""

    query: FloatMatrix
    key: FloatMatrix
    value: FloatMatrix
    score: FloatMatrix
    bias: FloatMatrix

    @classmethod
    def of(cls, told: MissionAttention) -> Self:
        """From what the edge tells; raises ``ValueError`` where that is no attention module of its preset."""
        arrays = {w.name: np.array(w.values, dtype=np.float32).reshape(w.shape) for w in told.weights}
        width, d = len(arrays.get("query", ())), FEATURES[told.features]
        shapes = {"query": (width, d), "key": (width, d), "value": (width, d), "score": (1, width), "bias": (1,)}
        if not width or {name: array.shape for name, array in arrays.items()} != shapes:
            raise ValueError(f"no attention of preset {told.features}: {[(w.name, w.shape) for w in told.weights]}")
        return cls(**arrays)

    def scores(self, features: FloatMatrix) -> FloatMatrix:
        """Scores ``(n,)`` of n sensors' features ``(n, d)``: ``softmax(Q K^T / sqrt(d')) V w + b``."""
        q, k, v = (features @ w.T for w in (self.query, self.key, self.value))
        scores = np.empty(len(features), dtype=np.float32)
        for start in range(0, len(features), _BLOCK):
            rows = slice(start, start + _BLOCK)
            logits = q[rows] @ k.T / np.sqrt(np.float32(len(self.query)))
            weights = np.exp(logits - logits.max(axis=1, keepdims=True))
            contexts = weights @ v / weights.sum(axis=1, keepdims=True)
            scores[rows] = contexts @ self.score[0] + self.bias
        return scores


class OnBoard:
    """What one UAV knows of its mission by itself: what it heard, and what it was told; nothing of the others'."""

    def __init__(self, mission_id: str, scenario: Scenario) -> None:
        self.mission_id = mission_id
        self.scenario = scenario
        self.told: MissionAttention | None = None
        self.etag: str | None = None
        self.asked_at = 0
        # Sensors and places of the last report that was answered: the edge knows where they are.
        self.surveyed: tuple[list[int], list[float], list[float]] | None = None
        self._attention: Attention | None = None
        self._records = Records(scenario)
        self._belief = FleetBelief(scenario)
        self._sent: tuple[str, int, int] | None = None

    def refreshed(self, told: MissionAttention, etag: str | None) -> None:
        """Score by these weights from now on; raises ``ValueError`` where they are none."""
        self._attention = Attention.of(told)
        self.told, self.etag = told, etag

    def hear(self, uav: UavState, step: int) -> None:
        """What the UAV heard, and what came of its last decision."""
        if uav.outcome is not None:
            self._settle(uav.outcome)
        take_report(uav, step, self._records, self._belief)

    def decided(self, response: DecideResponse) -> None:
        """The UAV was told what to do."""
        if self._sent is not None:
            # Nobody said what came of the one before.
            self._records.confirm(self._sent[1], self._sent[0], self._sent[2])
        self._sent = response.decision_id, response.sensor_id, response.step
        self._records.presume(response.sensor_id, response.decision_id, response.step)
        self._belief.tell(response.uav_id, response.step, response.sensor_id, response.velocity)

    def _settle(self, outcome: Outcome) -> None:
        if self._sent is None or self._sent[0] != outcome.decision_id:
            return
        name, sensor, step = self._sent
        if outcome.failed:
            self._records.withdraw(sensor, name)
        else:
            self._records.confirm(sensor, name, step)
        self._sent = None

    def kept(self, uav: UavState, step: int) -> list[int]:
        """Rows of the report to send, best first: the k that attention scores highest.

        Where fewer can be served than k, the nearest others follow: the edge must know of some.
        """
        assert self.told is not None and self._attention is not None
        state = augment(
            uav,
            step,
            self.scenario,
            visits=self._records.visits,
            rates=self._records.rates,
            reserved=(),
            preset=self.told.features,
            belief=self._belief if self.told.belief == "fleet" else None,
        )
        return _best(state, self._attention.scores(state.features(self.scenario)), self.told.top_k)


def _best(state: State, scores: FloatMatrix, k: int) -> list[int]:
    admissible = np.flatnonzero(state.admissible)
    best = admissible[np.argsort(-scores, kind="stable")[:k]]
    others = np.setdiff1d(np.arange(len(state.ids)), admissible)
    nearest = others[np.argsort(state.distance[others], kind="stable")[: k - len(best)]]
    rows: list[int] = np.concatenate((best, nearest)).tolist()
    return rows


class PrunedReports(FullReports):
    """Uplink ``pruned``: the sensors that the mission's attention would keep, by what the UAV itself knows.

    A UAV's first report tells all sensors and where they are. It asks for the weights before its first report and every
    ten steps, and holds those of the mission that it asked about last; without weights it reports in full.
    """

    def __init__(self) -> None:
        self._uavs: dict[int, OnBoard] = {}

    def _of(self, mission_id: str, uav_id: int) -> OnBoard | None:
        known = self._uavs.get(uav_id)
        return known if known is not None and known.mission_id == mission_id else None

    def missing(self, mission_id: str, step: int, uav_id: int) -> Fetch | None:
        """The mission's world, once; then its weights, now and then."""
        known = self._of(mission_id, uav_id)
        if known is None:
            return Fetch(f"/missions/{mission_id}", MissionStatus)
        if known.told is None or not known.asked_at <= step < known.asked_at + REFRESH_STEPS:
            return Fetch(f"/missions/{mission_id}/attention", MissionAttention, known.etag)
        return None

    def take(self, uav_id: int, step: int, told: BaseModel | None, etag: str | None) -> None:
        """Begin with this world, or score by these weights."""
        if isinstance(told, MissionStatus):
            self._uavs[uav_id] = OnBoard(told.mission_id, told.scenario)
            return
        if isinstance(told, MissionAttention):
            self._uavs[uav_id].refreshed(told, etag)
        self._uavs[uav_id].asked_at = step

    def reduced(self, mission_id: str, step: int, uav: Told) -> Told:
        """The rows kept, without their places; all of it the first time."""
        known = self._of(mission_id, uav.uav_id)
        if known is None:
            return uav
        known.hear(uav, step)
        if known.told is None or known.surveyed != (uav.sensors.id, uav.sensors.x, uav.sensors.y):
            return uav
        return uav.model_copy(update={"sensors": unplaced(uav.sensors, known.kept(uav, step))})

    def answered(self, uav: UavState, response: DecideResponse) -> None:
        """Where its sensors are is known at the edge from now on."""
        known = self._of(response.mission_id, uav.uav_id)
        if known is not None:
            known.surveyed = uav.sensors.id, uav.sensors.x, uav.sensors.y
            known.decided(response)

    def forget(self, uav_id: int) -> None:
        """The edge does not know where the sensors are (any more)."""
        if uav_id in self._uavs:
            self._uavs[uav_id].surveyed = None
