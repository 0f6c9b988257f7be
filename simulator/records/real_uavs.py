"""The part of a flight's summary that only real UAVs have: sums by UAV, and decisions not carried out."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType

from pydantic import Field

from simulator.records.decision import Decision, Record, percentile

# The ways decided and flown may differ by this share before the report warns.
_TOLERANCE = 0.05


class UavSums(Record):
    """One UAV's decisions and their outcomes.

    ``lost_packets`` are those of the sensors that it heard: a packet counts for each UAV that heard its sensor's
    beacon. ``rtt_ms`` is the median round trip, ``null`` without an answer of the edge. ``decided_m`` and ``flown_m``
    are the ways of the decisions at whose start and end its position was known, metres.
    """

    uav_id: int
    decisions: int
    collected: int
    failures: int
    lost_packets: int
    rtt_ms: float | None
    decided_m: float = 0.0
    flown_m: float = 0.0


class RealUavs(Record):
    """What a flight of real UAVs adds to a summary.

    ``late`` decisions came after the end of their waypoint's step. ``undecided`` counts the waypoints at which a UAV
    got no command, by the reason. ``not_carried_out`` has the texts of the commands that a vehicle did not carry out.
    ``ended`` has, by UAV, why it did not fly its mission at the end, and ``warnings`` what the vehicles' missions have
    that the world has not. ``simulated_lost`` are the packets that all simulated sensors have lost, reported by beacons
    or not; ``null`` with real sensors.
    """

    uavs: list[UavSums]
    late: int
    undecided: dict[str, int]
    not_carried_out: list[str]
    simulated_lost: int | None
    ended: dict[int, str] = Field(default_factory=dict)
    warnings: list[str] = Field(default_factory=list)

    def remarks(self) -> list[str]:
        """Sentences on what went otherwise than decided."""
        texts = [f"{count} waypoints without a decision: {why}." for why, count in self.undecided.items()]
        texts += [f"UAV {uav} did not fly its mission at the end: {why}." for uav, why in self.ended.items()]
        for one in self.uavs:
            if abs(one.flown_m - one.decided_m) > _TOLERANCE * one.decided_m:
                texts.append(
                    f"Warning: UAV {one.uav_id} flew {one.flown_m:,.0f} m where {one.decided_m:,.0f} m were decided."
                )
        if self.not_carried_out:
            texts.append(f"{len(self.not_carried_out)} commands not carried out; the last: {self.not_carried_out[-1]}.")
        return texts + [f"Warning: {text}." for text in self.warnings]


def sums_by_uav(
    decisions: Iterable[Decision], metres: Mapping[int, tuple[float, float]] = MappingProxyType({})
) -> list[UavSums]:
    """The sums of each UAV that decided, by its ID; ``metres`` has the ways decided and flown of each."""
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
            decided_m=metres.get(uav, (0.0, 0.0))[0],
            flown_m=metres.get(uav, (0.0, 0.0))[1],
        )
        for uav, mine in sorted(own.items())
    ]
