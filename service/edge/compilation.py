"""The functions that numba compiles: a decision waits neither for the compiler nor for what it made before."""

from __future__ import annotations

import numpy as np

from service.deciding import rollout_evaluator
from service.learning.initial_weights import initial_weights
from service.learning.learner import Learner
from service.learning.modules import Sample
from service.learning.softmax_means import softmax_means
from shared.features import FEATURES
from shared.fleetplan import annealing
from shared.learned_channel import LearnedChannel
from shared.scenario import SCENARIOS


def load_for_event_loop() -> None:
    """Load what the event loop calls, in half a second; the first time on a machine it takes some seconds to compile.

    The edge does so before it is ready. Threads load what plans and evaluates when a mission needs it.
    """
    one = np.zeros((1, 1), dtype=np.float32)
    softmax_means(one, one, one[0])
    learner = Learner(initial_weights("random", "paper", 1, 0), learning_rate=1e-3)
    features, approach = np.zeros((1, FEATURES["paper"]), dtype=np.float32), np.zeros(1, dtype=np.float32)
    learner.update(Sample(features=features, chosen=0, approach=approach, velocity=0), cost=1.0)
    channel, sensor = LearnedChannel(SCENARIOS["paper"]), np.zeros(1, dtype=np.int64)
    # The eighth measurement compares the kinds of shadowing.
    for excess_db in range(8):
        channel.measure(sensor, np.zeros(2), np.zeros(1), np.array([-100.0 - excess_db]))
    channel.links(np.zeros((1, 2)), np.zeros((1, 1)), sensor)


def compile_all() -> None:
    """Compile every function, or load it: installations do so in advance."""
    load_for_event_loop()
    annealing.warm_up()
    rollout_evaluator.warm_up()
