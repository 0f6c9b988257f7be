"""The part of a flight's summary that only real UAVs have: sums by UAV, and decisions not carried out."""

from collections.abc import Iterable

from simulator.records.decision import Decision
from simulator.records.record import Record
from simulator.records.statistics import percentile


class UavSums(Record):
    """One UAV's decisions and their outcomes.

    ``lost_packets`` are those of the sensors that it heard: a packet counts for each UAV that heard its sensor's
    beacon. ``rtt_ms`` is the median round trip, ``null`` without an answer of the edge.
    """

    uav_id: int
    decisions: int
    collected: int
    failures: int
    lost_packets: int
    rtt_ms: float | None


class RealUavs(Record):
    """What a flight of real UAVs adds to a summary.

    ``late`` decisions came after the end of their waypoint's step. ``undecided`` counts the waypoints at which a UAV
    got no command, by the reason. ``not_carried_out`` has the texts of the commands that a vehicle did not carry out.
    ``simulated_lost`` are the packets that all simulated sensors have lost, reported by beacons or not; ``null`` with
    real sensors.
    """

    uavs: list[UavSums]
    late: int
    undecided: dict[str, int]
    not_carried_out: list[str]
    simulated_lost: int | None


def sums_by_uav(decisions: Iterable[Decision]) -> list[UavSums]:
    """The sums of each UAV that decided, by its ID."""
    own: dict[int, list[Decision]] = {}
    for decision in decisions:
        own.setdefault(decision.uav_id, []).append(decision)
    return [
        UavSums(
            uav_id=uav,
            decisions=len(mine),
            collected=sum(d.collected for d in mine),
            failures=sum(d.failed for d in mine),
            lost_packets=sum(d.lost_packets for d in mine),
            rtt_ms=percentile([d.rtt_ms for d in mine if d.rtt_ms is not None], 50),
        )
        for uav, mine in sorted(own.items())
    ]
