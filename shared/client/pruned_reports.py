"""Pruning on board: a UAV scores the sensors with its mission's attention, in numpy, and reports the k best."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from shared.belief.fleet_belief import FleetBelief
from shared.belief.records import Records, take_report
from shared.client.report_encoders import Fetch, FullReports, Report, without_positions
from shared.features.augmented_state import FEATURES, State, augment
from shared.wire.missions import MissionAttention, MissionStatus
from shared.wire.schemas import DecideResponse, UavState
from shared.world.scenario import Scenario

# Steps between a UAV's checks that its weights are still current.
REFRESH_STEPS = 10
# Queries a block.
_BLOCK = 256

FloatMatrix = NDArray[np.float32]


@dataclass(frozen=True)
class AttentionWeights:
    """``W_q``, ``W_k``, ``W_v`` ``(d', d)``, and the score's ``w`` ``(1, d')`` and ``b`` ``(1,)``."""

    query: FloatMatrix
    key: FloatMatrix
    value: FloatMatrix
    score: FloatMatrix
    bias: FloatMatrix

    @classmethod
    def of(cls, published: MissionAttention) -> Self:
        """The weights that the edge publishes; raises ``ValueError`` for shapes that do not fit the feature preset."""
        arrays = {w.name: np.array(w.values, dtype=np.float32).reshape(w.shape) for w in published.weights}
        width, d = len(arrays.get("query", ())), FEATURES[published.features]
        shapes = {"query": (width, d), "key": (width, d), "value": (width, d), "score": (1, width), "bias": (1,)}
        if not width or {name: array.shape for name, array in arrays.items()} != shapes:
            got = [(w.name, w.shape) for w in published.weights]
            raise ValueError(f"no attention of preset {published.features}: {got}")
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


class UavKnowledge:
    """One UAV's own knowledge of its mission: the beacons that it heard and the answers to it, not other UAVs'."""

    def __init__(self, mission_id: str, scenario: Scenario) -> None:
        self.mission_id = mission_id
        self.scenario = scenario
        self.published: MissionAttention | None = None
        self.etag: str | None = None
        self.checked_at = 0
        # Sensors and positions of the last answered report: the edge has them.
        self.known_positions: tuple[list[int], list[float], list[float]] | None = None
        self._attention: AttentionWeights | None = None
        self._records = Records(scenario)
        self._belief = FleetBelief(scenario)
        self._pending: DecideResponse | None = None

    def set_weights(self, published: MissionAttention, etag: str | None) -> None:
        """Score by these weights from now on; raises ``ValueError`` for invalid ones."""
        self._attention = AttentionWeights.of(published)
        self.published, self.etag = published, etag

    def record_report(self, uav: UavState, step: int) -> None:
        """Record the UAV's report and the outcome of its last decision."""
        last, outcome = self._pending, uav.outcome
        if outcome is not None and last is not None and last.decision_id == outcome.decision_id:
            self._belief.settle(uav.uav_id, last.step, outcome.failed)
            if outcome.failed:
                self._records.withdraw(last.sensor_id, last.decision_id)
            else:
                self._records.confirm(last.sensor_id, last.decision_id, last.step)
            self._pending = None
        take_report(uav, step, self._records, self._belief)

    def record_decision(self, response: DecideResponse) -> None:
        """Record the edge's decision for the UAV."""
        if (last := self._pending) is not None:
            # The previous decision has no outcome: its presumed visit is confirmed.
            self._records.confirm(last.sensor_id, last.decision_id, last.step)
        self._pending = response
        self._records.presume(response.sensor_id, response.decision_id, response.step)
        self._belief.record_decision(response.uav_id, response.step, response.sensor_id, response.velocity)

    def best_rows(self, uav: UavState, step: int) -> list[int]:
        """Rows of the report to send, best first: the k with the highest attention scores.

        With fewer than k admissible sensors, the nearest others follow, since the edge needs some sensors.
        """
        assert self.published is not None and self._attention is not None
        visits, rates, preset = self._records.visits, self._records.rates, self.published.features
        belief = self._belief if self.published.belief == "fleet" else None
        state = augment(uav, step, self.scenario, visits=visits, rates=rates, reserved=(), preset=preset, belief=belief)
        return _best_rows(state, self._attention.scores(state.features(self.scenario)), self.published.top_k)


def _best_rows(state: State, scores: FloatMatrix, k: int) -> list[int]:
    admissible = np.flatnonzero(state.admissible)
    best = admissible[np.argsort(-scores, kind="stable")[:k]]
    others = np.setdiff1d(np.arange(len(state.ids)), admissible)
    nearest = others[np.argsort(state.distance[others], kind="stable")[: k - len(best)]]
    rows: list[int] = np.concatenate((best, nearest)).tolist()
    return rows


class PrunedReports(FullReports):
    """Uplink ``pruned``: the sensors that the mission's attention selects, from the UAV's own knowledge.

    A UAV's first report has all sensors and their positions. The UAV fetches the weights before its first report and
    once in ``REFRESH_STEPS`` steps, and stores those of its latest mission. Without weights it reports in full.
    """

    def __init__(self) -> None:
        self._uavs: dict[int, UavKnowledge] = {}

    def _knowledge(self, mission_id: str, uav_id: int) -> UavKnowledge | None:
        known = self._uavs.get(uav_id)
        return known if known is not None and known.mission_id == mission_id else None

    def next_fetch(self, mission_id: str, step: int, uav_id: int) -> Fetch | None:
        """The mission's scenario, once; then its weights, once in ``REFRESH_STEPS`` steps."""
        known = self._knowledge(mission_id, uav_id)
        if known is None:
            return Fetch(f"/missions/{mission_id}", MissionStatus)
        if known.published is None or not known.checked_at <= step < known.checked_at + REFRESH_STEPS:
            return Fetch(f"/missions/{mission_id}/attention", MissionAttention, known.etag)
        return None

    def store(self, uav_id: int, step: int, fetched: BaseModel | None, etag: str | None) -> None:
        """Begin a mission with this scenario, or score by these weights."""
        if isinstance(fetched, MissionStatus):
            self._uavs[uav_id] = UavKnowledge(fetched.mission_id, fetched.scenario)
            return
        if isinstance(fetched, MissionAttention):
            self._uavs[uav_id].set_weights(fetched, etag)
        self._uavs[uav_id].checked_at = step

    def encode(self, mission_id: str, step: int, uav: Report) -> Report:
        """The selected rows without their positions; the full report the first time."""
        known = self._knowledge(mission_id, uav.uav_id)
        if known is None:
            return uav
        try:
            known.record_report(uav, step)
        except IndexError:
            # The mission has no such UAV or sensor: the edge says which.
            return uav
        if known.published is None or known.known_positions != (uav.sensors.id, uav.sensors.x, uav.sensors.y):
            return uav
        return uav.model_copy(update={"sensors": without_positions(uav.sensors, known.best_rows(uav, step))})

    def record_answer(self, uav: UavState, response: DecideResponse) -> None:
        """The edge has the positions of these sensors from now on."""
        known = self._knowledge(response.mission_id, uav.uav_id)
        if known is not None:
            known.known_positions = uav.sensors.id, uav.sensors.x, uav.sensors.y
            known.record_decision(response)

    def forget(self, uav_id: int) -> None:
        """The edge lacks the sensors' positions: the next report is sent in full."""
        if uav_id in self._uavs:
            self._uavs[uav_id].known_positions = None
