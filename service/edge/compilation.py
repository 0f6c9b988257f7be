"""Compiling and loading numba's functions in advance, so that no decision waits for either."""

import subprocess
import sys

import numpy as np

from service.deciding import rollout_evaluator
from service.learning.initial_weights import initial_weights
from service.learning.learner import Learner
from service.learning.modules import Sample
from service.learning.softmax_means import softmax_means
from shared.belief.fleet_belief import FleetBelief
from shared.belief.learned_channel import ExpectedLinks
from shared.belief.records import Records, take_report
from shared.features.augmented_state import FEATURES, augment
from shared.kit.memory import release_library
from shared.planning import annealing
from shared.wire.schemas import SensorColumns, UavState
from shared.world.scenario import SCENARIOS

_PAPER = SCENARIOS["paper"]


def load_for_event_loop() -> None:
    """Load the functions that the event loop calls: half a second, or some seconds to compile them the first time.

    The edge does so before it is ready. Threads load the planner's and the evaluator's functions on demand.
    """
    one = np.zeros((1, 1), dtype=np.float32)
    softmax_means(one, one, one[0])
    learner = Learner(initial_weights("random", "paper", 1, 0), learning_rate=1e-3)
    features, approach = np.zeros((1, FEATURES["paper"]), dtype=np.float32), np.zeros(1, dtype=np.float32)
    learner.update(Sample(features=features, chosen=0, approach=approach, velocity=0), cost=1.0)
    belief, records = FleetBelief(_PAPER), Records(_PAPER)
    # The eighth measurement compares the kinds of shadowing.
    for step in range(8):
        uav = UavState(uav_id=0, position=[500.0, 500.0], sensors=_heard(step))
        take_report(uav, step, records, belief)
        state = augment(
            uav, step, _PAPER, visits=records.visits, rates=None, reserved=(), preset="reach", belief=belief
        )
    belief.channel.transfer(0.0)
    ExpectedLinks.by_formula(state.distance[None], _PAPER)
    # The compiler takes 70 MB; to load further functions takes 8 MB of it.
    release_library("libllvmlite")


def _heard(step: int) -> SensorColumns:
    """One sensor, heard in this step, with a gain that no formula expects."""
    return SensorColumns(
        id=[0], x=[500.0], y=[500.0], queue=[0.0], battery=[1.0], channel_gain=[-100.0 - step], last_seen=[step]
    )


def compile_all() -> None:
    """Compile or load every function, on two cores; installations call it.

    Raises:
        subprocess.CalledProcessError: the functions of the planner cannot be compiled.
    """
    # The planner's functions take as long as all others together.
    command = [sys.executable, "-c", f"from {annealing.__name__} import warm_up; warm_up()"]
    with subprocess.Popen(command) as planner:
        load_for_event_loop()
        rollout_evaluator.warm_up()
    if planner.returncode:
        raise subprocess.CalledProcessError(planner.returncode, command)
