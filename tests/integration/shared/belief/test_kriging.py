"""The radio map's compiled functions: they compute what plain Python and the formulas do, and are compiled once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shared.belief import kriging, link_expectations, shadowing
from shared.belief.learned_channel import LearnedChannel
from shared.belief.radio_map import RadioMap
from shared.belief.shadowing import KINDS, OFFSET_WEIGHT, PRIOR_DB, PRIOR_WEIGHT
from shared.world.channel import Links, path_loss_db
from shared.world.scenario import SCENARIOS

PAPER = SCENARIOS["paper"]
# A fleet's measurements and what it expects then; with an argument numba is missing, as beside the simulator alone.
FLOWN = """
import json, sys
if len(sys.argv) > 1:
    sys.modules["numba"] = None
import numpy as np
from shared.belief.learned_channel import LearnedChannel
from shared.world.scenario import SCENARIOS
random, channel = np.random.default_rng(0), LearnedChannel(SCENARIOS["paper"])
for step in range(60):
    ids = np.sort(random.choice(10, random.integers(1, 5), replace=False))
    place = np.array([40.0 * (step % 9), 5.0 * (step % 2)])
    channel.measure(ids, place, random.uniform(0, 300, len(ids)), random.normal(-95, 8, len(ids)))
links = channel.links(random.uniform(0, 400, (4, 2)), random.uniform(0, 400, (4, 10)))
print(json.dumps([channel.radio_map.heard, links.packets.tolist(), links.hold.tolist()]))
"""
PLANNED = """
import sys
sys.modules["numba"] = None
from shared.kit.command_line import main
sys.argv = ["aicvds", "simulate", "--policy", "mpc", "--out", sys.argv[1]]
sys.exit(main())
"""


def ran(program: str, *arguments: str) -> str:
    """What a program prints in a process of its own."""
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_numba_plain_python_expects_the_same_links() -> None:
    (heard, packets, hold), (its_heard, its_packets, its_hold) = (
        json.loads(ran(FLOWN, *arguments)) for arguments in ((), ("without",))
    )
    assert heard == its_heard and packets == its_packets
    np.testing.assert_allclose(hold, its_hold, atol=1e-9)


def test_without_numba_the_planner_names_the_extra(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PLANNED, str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "numba is not installed" in done.stderr and "aic-vds[planner]" in done.stderr


@pytest.mark.parametrize("laps", [1, 4])
def test_the_likelihoods_are_the_normal_distributions(laps: int) -> None:
    random, found = np.random.default_rng(laps), RadioMap(4)
    for number in range(20 * laps):
        place = np.array([45.0 * (number % 20), 3.0 * (number // 20)])
        found.measure(np.sort(random.choice(4, 2, replace=False)), place, random.normal(3, 9, 2))
    # One wrong report, whose noise is larger.
    found.measure(np.array([1]), np.array([50.0, 1.0]), np.array([40.0]))
    assert found.noise.max() > 1
    state, expected = found.state_dict(), []
    for kind in KINDS:
        measured, ones, blocks = [], [], []
        for sensor in range(4):
            used = slice(0, int(found.count[sensor]))
            places = found.places[sensor, used]
            apart = np.linalg.norm(places[:, None] - places[None], axis=2)
            matrix = kind.sensor + kind.place * np.exp(-apart / kind.range_m)
            np.fill_diagonal(matrix, 1.0 + kind.fading * (found.noise[sensor, used] - 1.0))
            blocks.append((matrix, found.excess[sensor, used]))
            measured.append(np.linalg.solve(matrix, found.excess[sensor, used]))
            ones.append(np.linalg.solve(matrix, np.ones(len(places))))
        offset = sum(m.sum() for m in measured) / (sum(o.sum() for o in ones) + OFFSET_WEIGHT)
        squares = sum(
            ((r - offset) * (m - offset * o)).sum() for (_, r), m, o in zip(blocks, measured, ones, strict=True)
        )
        every = int(state["count"].sum())
        variance = (PRIOR_WEIGHT * PRIOR_DB**2 + squares) / (PRIOR_WEIGHT + every)
        spread = sum(np.linalg.slogdet(matrix)[1] for matrix, _ in blocks)
        expected.append(-0.5 * every * np.log(variance) - 0.5 * spread)
    kept = np.zeros((*found.excess.shape, 7))
    kept[..., :2], kept[..., 2], kept[..., 3] = found.places, found.excess, found.noise
    np.testing.assert_allclose(shadowing.likelihoods(kept, found.count), expected, rtol=1e-9)


def test_expected_transfers_are_those_of_the_formulas_links_with_the_excess_loss() -> None:
    random, channel = np.random.default_rng(0), LearnedChannel(PAPER)
    metres = random.uniform(0, 450, (30, 10))
    mean, deviation = random.normal(0, 8, metres.shape), random.uniform(0, 5, metres.shape)
    deviation[:3] = 0.0
    # A loss at the threshold itself, known for certain: the link does not hold.
    mean[0, 0] = PAPER.path_loss_limit_db - path_loss_db(metres[0, 0], PAPER)
    packets, margin = np.empty(metres.shape, dtype=np.int64), np.empty(metres.shape)
    link_expectations.expected_transfers(channel._budget, 0.5, metres, mean, deviation, packets, margin)
    near, loss = metres <= PAPER.radio_radius_m, path_loss_db(metres, PAPER) + mean
    with np.errstate(divide="ignore", invalid="ignore"):
        spare = (PAPER.path_loss_limit_db - loss) / deviation
    expected = np.where(near & ~np.isnan(spare), spare, -np.inf)
    whole = Links(metres, np.minimum(loss, PAPER.path_loss_limit_db - 1e-9), PAPER).packets
    assert 0 < (expected > -3).sum() < expected.size and not near.all()
    np.testing.assert_array_equal(packets, np.where(expected > -3, np.floor(whole * 0.5 + 1e-9), 0))
    np.testing.assert_array_equal(np.isinf(margin[1:]), np.isinf(expected[1:]))
    finite = np.isfinite(expected)
    np.testing.assert_allclose(margin[finite], expected[finite], atol=1e-9)


def test_no_form_of_an_array_is_compiled_anew() -> None:
    """On the event loop every decision would wait for the compiler."""
    functions = [
        kriging.take_measurements,
        kriging.predict,
        kriging.invert,
        kriging.estimated,
        shadowing._sum,
        link_expectations.measured_excess,
        link_expectations.expected_transfers,
    ]
    channel = LearnedChannel(PAPER)
    ids = np.arange(4)
    ids.flags.writeable = False
    for turn in range(30):
        place = np.array([turn * 20.0, 0.0])
        distance, gain = np.linspace(0, 300, 8)[::2], np.linspace(-90, -80, 8)[::2]
        channel.measure(ids, place, distance, gain - turn)
        for count in (1, 4):
            for places in (np.zeros((2, 1)).T, np.zeros((2, 3)).T, np.zeros((1, 2)), np.zeros((3, 2))[::2]):
                metres = np.zeros((count, len(places))).T
                channel.links(places, metres, ids[::2][:1] if count == 1 else ids)
        channel.packets((0.0, 0.0), np.zeros(2), 1, held=True)
        channel.gain_db(np.zeros(2), np.zeros(4), ids)
        again = LearnedChannel(PAPER)
        again.load_state_dict(channel.state_dict())
        channel = again
    counted = {function.__name__: len(function.signatures) for function in functions}  # type: ignore[attr-defined]
    assert counted == dict.fromkeys(counted, 1)
