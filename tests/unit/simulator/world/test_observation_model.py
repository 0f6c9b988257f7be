"""Without beacons a UAV observes only the sensor that it served."""

import numpy as np

from shared.world.scenario import SCENARIOS
from simulator.world.environment import PipelineWorld

SERVED = SCENARIOS["paper"].model_copy(update={"observation_model": "served"})


def test_a_uav_hears_the_sensor_that_it_served_and_no_other() -> None:
    world, same = PipelineWorld(SERVED), PipelineWorld()
    seen, _ = world.reset(seed=3)
    same.reset(seed=3)
    assert all((one["last_heard"] == -1).all() for one in seen.values())
    served = failed = 0
    for step in range(1, SERVED.steps + 1):
        actions = {agent: (int((step + 3 * uav) % 10), 7) for agent, uav in world.live.items()}
        before = {agent: one["last_heard"].copy() for agent, one in seen.items()}
        seen, _, _, _, infos = world.step(actions)
        same.step(actions)
        for agent, one in seen.items():
            expected = before[agent]
            if infos[agent]["failed"]:
                failed += 1
            else:
                served += 1
                sensor = actions[agent][0]
                expected[sensor] = step
                assert one["queue"][sensor] == world.sensors.queue[sensor]
            np.testing.assert_array_equal(one["last_heard"], expected)
    assert served > 5 and failed > 5
    # The worlds themselves are the same.
    assert [t.lost_packets for t in world.tally] == [t.lost_packets for t in same.tally]
