"""Expected links of a UAV by the formula and a radio map, compiled as :mod:`shared.belief.kriging` is."""

import math

from shared.kit.compiled import compiled, inlined
from shared.world.channel import FloatArray, IntArray, LinkBudget, mean_loss_db, whole_rate_bps

# A link below this margin hardly ever holds.
_LEAST_MARGIN = -3.0

# A loss this far below the one that caps the rate is certain to cap it, dB.
_ROUNDING_DB = 1e-6

_mean_loss_db, _whole_rate_bps = inlined(mean_loss_db), inlined(whole_rate_bps)


@inlined
def _capped_db(world: LinkBudget) -> float:
    """A loss below which the modulation's cap is the rate of every link."""
    noise_dbm = world.noise_dbm_hz + 10.0 * math.log10(world.bandwidth_hz) + world.noise_figure_db
    snr_db = 10.0 * math.log10(2.0**world.spectral_cap - 1.0)
    return 10.0 * math.log10(world.transmit_power_w * 1e3) - noise_dbm - snr_db - _ROUNDING_DB


@inlined
def _rate_bps(loss_db: float, capped_db: float, world: LinkBudget) -> float:
    """As :func:`shared.world.channel.whole_rate_bps`: most links have the capped rate, which needs no logarithm."""
    if loss_db < capped_db:
        return world.link_share * world.bandwidth_hz * world.spectral_cap
    return float(_whole_rate_bps(loss_db, world))


@inlined
def _packets(rate_bps: float, world: LinkBudget) -> int:
    """Whole packets that a step moves at a rate."""
    return int(math.floor(rate_bps * world.step_s / world.packet_bits + 1e-9))


@compiled
def measured_excess(world: LinkBudget, distance: FloatArray, gain_db: FloatArray, excess_db: FloatArray) -> None:
    """The excess losses over the formula of n links, dB, from their distances, metres, and their measured gains."""
    for n in range(distance.shape[0]):
        excess_db[n] = -gain_db[n] - _mean_loss_db(distance[n], world)


@inlined
def _formula_transfer(metres: float, capped_db: float, world: LinkBudget) -> tuple[int, bool]:
    """Packets that a step moves over a link of the mean path loss in radio range, and whether it holds."""
    loss = _mean_loss_db(metres, world)
    holds = loss < world.path_loss_limit_db
    return (_packets(_rate_bps(loss, capped_db, world), world) if holds else 0), holds


@compiled
def know_rings(world: LinkBudget, packets: IntArray, hold: FloatArray) -> None:
    """Write the packets and whether they hold, 1 or 0, of links of the mean path loss to K rings around a UAV.

    The rings are equally wide and fill the radio range. ``packets`` is -1 where a ring's links differ: where those at
    its edges do, or where the loss does not grow with the distance.
    """
    width, capped_db = world.radio_radius_m / packets.shape[0], _capped_db(world)
    grows = world.nlos_excess_db >= world.los_excess_db and world.los_kappa >= 0.0
    for ring in range(packets.shape[0]):
        inner, inner_holds = _formula_transfer(ring * width, capped_db, world)
        outer, outer_holds = _formula_transfer((ring + 1) * width, capped_db, world)
        same = grows and inner == outer and inner_holds == outer_holds
        packets[ring], hold[ring] = inner if same else -1, 1.0 if inner_holds else 0.0


@compiled
def formula_transfers(
    world: LinkBudget,
    ring_packets: IntArray,
    ring_hold: FloatArray,
    metres: FloatArray,
    packets: IntArray,
    hold: FloatArray,
) -> None:
    """Write the packets and whether they hold, 1 or 0, of links ``(P, n)`` of the mean path loss.

    Args:
        ring_packets, ring_hold: of :func:`know_rings`.
        metres: horizontal distances.
    """
    capped_db, last = _capped_db(world), ring_packets.shape[0] - 1
    rings_a_metre = ring_packets.shape[0] / world.radio_radius_m
    for p in range(metres.shape[0]):
        for n in range(metres.shape[1]):
            if not metres[p, n] <= world.radio_radius_m:
                packets[p, n], hold[p, n] = 0, 0.0
                continue
            ring = min(int(metres[p, n] * rings_a_metre), last)
            packets[p, n], hold[p, n] = ring_packets[ring], ring_hold[ring]
            if ring_packets[ring] < 0:
                moved, holds = _formula_transfer(metres[p, n], capped_db, world)
                packets[p, n], hold[p, n] = moved, 1.0 if holds else 0.0


@compiled
def transfer(world: LinkBudget, loss_db: float) -> tuple[float, int]:
    """A packet's energy, joules, and the packets that a step moves, over a working link."""
    rate = _whole_rate_bps(loss_db, world)
    return world.transmit_power_w * (world.packet_bits / max(rate, 1e-12)), _packets(rate, world)


@compiled
def expected_transfers(
    world: LinkBudget,
    share: float,
    metres: FloatArray,
    mean_db: FloatArray,
    deviation_db: FloatArray,
    packets: IntArray,
    margin: FloatArray,
) -> None:
    """Packets and margins of links ``(P, n)``, as :class:`shared.belief.learned_channel.ExpectedLinks` has them.

    Args:
        share: the rate that transfers get, as a share of the formula's.
        metres: horizontal distances.
        mean_db, deviation_db: of the excess losses.
        packets, margin: are written.
    """
    capped_db = _capped_db(world)
    for p in range(metres.shape[0]):
        for n in range(metres.shape[1]):
            packets[p, n], margin[p, n] = 0, -math.inf
            if not metres[p, n] <= world.radio_radius_m:
                continue
            loss = _mean_loss_db(metres[p, n], world) + mean_db[p, n]
            spare = world.path_loss_limit_db - loss
            if deviation_db[p, n] > 0.0:
                margin[p, n] = spare / deviation_db[p, n]
            elif spare != 0.0:
                margin[p, n] = math.copysign(math.inf, spare)
            if margin[p, n] > _LEAST_MARGIN:
                # A link that works against expectation has a loss just below the threshold.
                rate = _rate_bps(min(loss, world.path_loss_limit_db - 1e-9), capped_db, world)
                packets[p, n] = int(math.floor(_packets(rate, world) * share + 1e-9))
