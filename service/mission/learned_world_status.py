"""The part of a mission's status about what its fleet has learned of the world."""

from __future__ import annotations

from shared.belief.fleet_belief import FleetBelief
from shared.wire.missions import LearnedWorld

# The least mean excess loss of a reported sensor, dB.
_REPORTED_DB = 1.0


def learned_world(belief: FleetBelief) -> LearnedWorld | None:
    """How the world differs from the scenario's formulas; None where nothing yet shows that it does."""
    channel, dispersion = belief.channel, belief.arrivals.dispersion
    if channel.by_formula and belief.drift.none and dispersion == 1.0:
        return None
    measured = channel.radio_map.measured_db()
    east, north = belief.drift.wind.tolist()
    return LearnedWorld(
        offset_db=channel.radio_map.offset_db,
        deviation_db=channel.radio_map.deviation_db,
        rate_share=channel.share,
        wind=[east, north],
        dispersion=dispersion,
        failed_radios=channel.failures.dead,
        excess_db={sensor: excess for sensor, excess in measured.items() if abs(excess) > _REPORTED_DB},
    )
