"""The readings of EOF and WQCS include those that fly by the names."""

from __future__ import annotations

from lab.benchmarks.scheme_readings import readings
from simulator.flying.flight import rollout
from simulator.world.environment import PipelineWorld


def test_the_policies_are_two_of_the_readings() -> None:
    flown = {
        name: [t.lost_packets for t in rollout(PipelineWorld(), policy, 0)]
        for name, policy in readings().items()
        if name in ("eof", "wqcs", "wqcs_coordinated") or "by distance" in name
    }
    assert flown["eof"] == flown["EOF: newest rise; power gain; by distance"]
    assert flown["wqcs"] == flown["WQCS: by distance; each for itself; in reach"]
    assert flown["wqcs_coordinated"] == flown["WQCS: by distance; coordinated; in reach"]
    assert len({tuple(lost) for lost in flown.values()}) > 6
