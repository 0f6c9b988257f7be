"""What a fleet has learned and met comes back to the bit: from events, and from a checkpoint and events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.api.mission_answers import status_of
from service.config.settings import Settings
from service.edge.stored_missions import restore_mission
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal
from service.storage.store import Store
from shared.planning.guidance_messages import GuidanceAnswer
from shared.planning.orders import Guidance, SensorWish
from shared.wire.schemas import MissionSpec, Outcome, SensorColumns, UavState
from shared.world.channel import channel_gain_db
from shared.world.step_rule import Action
from shared.world.trajectory import trajectories
from tests.support.missions import PAPER, attended
from tests.support.stored_missions import same, state
from tests.support.waiting import PATIENCE_S

RADIUS_M, SENSORS = PAPER.radio_radius_m, 10


class Flight:
    """Three UAVs in a world with shadowing, wind and bursts; every third transmission fails."""

    def __init__(self, mission: Mission) -> None:
        self.mission = mission
        self._random = np.random.default_rng(7)
        self._shadowing = self._random.normal(2.0, 7.0, SENSORS)
        self._places = self._random.uniform(150.0, 850.0, (SENSORS, 2))
        self._progress = [0.0] * PAPER.uavs
        self._owed: dict[int, str] = {}

    def fly(self, steps: range) -> None:
        """All UAVs' reports, outcomes and decisions."""
        for step in steps:
            for uav in range(PAPER.uavs):
                self._turn(uav, step)

    def _turn(self, uav: int, step: int) -> None:
        number = step * PAPER.uavs + uav
        if uav in self._owed:
            failed = number % 3 == 0
            sample = self.mission.apply(Outcome(decision_id=self._owed[uav], cost=float(failed), failed=failed))
            if sample is not None:
                self.mission.learn(sample, float(failed))
        report = self._report(uav, step)
        attempt = self.mission.observe(report, step)
        decision = attended(self.mission, report, step).pending(f"{number:032x}", Action(report.sensors.id[0], 9))
        self.mission.commit(decision, attempt)
        self._owed[uav] = decision.decision_id
        self._progress[uav] += 9 * PAPER.step_s * (1.1 + 0.05 * uav)

    def _report(self, uav: int, step: int) -> UavState:
        here = trajectories(PAPER)[uav].at(self._progress[uav])
        away = np.hypot(*(self._places - here).T)
        heard = np.argsort(away)[: max(2, int((away <= RADIUS_M).sum()))]
        gain = channel_gain_db(away[heard], PAPER) - self._shadowing[heard] - self._random.normal(0, 2, len(heard))
        queue = np.minimum(self._random.poisson(12 if step % 20 < 5 else 4, len(heard)) * (1 + step % 5), 60)
        columns = SensorColumns(
            id=heard.tolist(),
            x=self._places[heard, 0].tolist(),
            y=self._places[heard, 1].tolist(),
            queue=queue.astype(float).tolist(),
            battery=[50.0] * len(heard),
            channel_gain=gain.tolist(),
            last_seen=[step] * len(heard),
        )
        x, y = (float(metres) for metres in here)
        return UavState(uav_id=uav, position=[x, y], progress_m=self._progress[uav], sensors=columns)


def visits(every: int) -> Guidance:
    """Orders to visit every sensor."""
    return Guidance(sensors=[SensorWish(sensor_id=sensor, visit_every=every) for sensor in range(SENSORS)])


def the_same(one: Mission, other: Mission) -> None:
    """Both know, tell and predict the same, to the bit."""
    assert same(state(one), state(other))
    assert status_of(one) == status_of(other)
    ways = np.arange(0.0, 1200.0, 10.0)
    for uav in range(PAPER.uavs):
        ours, theirs = one.belief.links(uav, ways), other.belief.links(uav, ways)
        np.testing.assert_array_equal(ours.packets, theirs.packets)
        np.testing.assert_array_equal(ours.hold, theirs.hold)
    step = (one.belief.newest or 0) + 3
    np.testing.assert_array_equal(one.belief.queue(step), other.belief.queue(step))


@pytest.mark.parametrize("checkpointed", [False, True], ids=["events alone", "a checkpoint and events"])
async def test_a_restored_mission_expects_the_same_links(tmp_path: Path, checkpointed: bool) -> None:
    store, settings = Store(str(tmp_path / "m.db")), Settings(mode="value")
    journal = Journal(store, Metrics())
    mission = Mission("test", MissionSpec(mode="value", planner="off"), settings)
    journal.begin(mission)
    flight = Flight(mission)
    mission.answer_guidance(GuidanceAnswer(guidance=visits(3)))
    flight.fly(range(13))
    if checkpointed:
        track = journal.due(mission, 1)
        assert track is not None
        journal.checkpoint(track, state(mission))
    mission.answer_guidance(GuidanceAnswer(guidance=visits(2)))
    flight.fly(range(13, 20))
    assert await journal.stored(PATIENCE_S)
    kept = store.load("test")
    assert kept is not None
    assert (kept.state is not None) == checkpointed and len(kept.events) > 20
    again = restore_mission("test", kept, settings)
    learned = status_of(mission).learned
    assert learned is not None
    # The world is one that there is something to learn of.
    assert learned.deviation_db > 2.0 and len(learned.excess_db) >= 4
    assert abs(learned.wind[0]) + abs(learned.wind[1]) > 0.01
    assert not mission.belief.channel.failures.none
    counts = mission.belief.channel.radio_map.count
    assert len(set(counts[counts > 0].tolist())) > 2
    # Of ended orders and of those in force, some deadlines were met and others missed.
    spans = [mission.deadlines()[:SENSORS], mission.deadlines()[SENSORS:]]
    assert all(sum(one.met for one in span) and sum(one.missed for one in span) for span in spans)
    the_same(mission, again)
    assert await journal.close(PATIENCE_S)
    store.close()
