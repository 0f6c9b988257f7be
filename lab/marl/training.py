"""The loop of a training: rounds of missions, the learning curve, logs, and a state to resume from."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from lab.marl import checkpoint
from lab.marl.curve import Point
from lab.marl.evaluate import lost_packets
from lab.marl.plan import STATE, TrainingPlan
from lab.training_seeds import FIRST_TRAINING_SEED
from shared.world.scenario import Scenario
from simulator.errors import UsageError

TENSORBOARD = "tensorboard"
_CURVE_POINTS = 50
# Apart from the training worlds, which begin a million later, and from the worlds of `python -m lab explore`.
_HELD_OUT = range(FIRST_TRAINING_SEED + 900_000, FIRST_TRAINING_SEED + 900_100)


class Round(NamedTuple):
    """The results of a round: the mean loss, and the means over its missions of the lost packets and the return."""

    loss: float
    lost_packets: float
    reward: float


class MarlScheme(Protocol):
    """A scheme in training; a round is ``worlds`` missions, and ``network`` is that of the actors."""

    @property
    def worlds(self) -> int: ...

    @property
    def network(self) -> nn.Module: ...

    def round(self) -> Round:
        """Fly and learn once."""
        ...

    def state(self) -> dict[str, Any]:
        """Tensors and plain values from which ``restore`` continues."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a ``state``."""
        ...


class Training:
    """A training from its start, or from the saved state of an earlier one with the same plan.

    Attributes:
        learner: the scheme in training.
        points: the learning curve so far.
        episodes: the missions flown so far.
    """

    def __init__(self, plan: TrainingPlan, make: Callable[[Scenario, int, int], MarlScheme], out: Path) -> None:
        torch.set_num_threads(plan.threads)
        torch.manual_seed(plan.seed)
        self.plan = plan
        self.learner = make(plan.scenario, plan.episodes, plan.first_seed)
        if plan.episodes % self.learner.worlds:
            raise UsageError(
                f"--episodes {plan.episodes} is not a multiple of {self.learner.worlds}, the missions flown together"
            )
        self.points: list[Point] = []
        self.episodes = 0
        self._rounds: list[Round] = []
        self._out = out

    def resume(self) -> None:
        """Continue from the state in the folder.

        Raises:
            UsageError: the folder has no state, or one of another plan.
        """
        try:
            state = checkpoint.read(self._out / STATE)
        except FileNotFoundError:
            raise UsageError(f"--resume: there is no {STATE} in {self._out}; start without --resume") from None
        except ValueError as error:
            raise UsageError(f"--resume: {error}; start again with another --out") from None
        for name, value in self.plan.plain().items():
            if state["plan"].get(name) != value:
                saved = state["plan"].get(name)
                raise UsageError(f"--{name} differs from the training in {self._out}" + _remedy(name, saved))
        self.learner.restore(state["learner"])
        torch.set_rng_state(state["random"])
        self.episodes = state["episodes"]
        self.points = [Point(**point) for point in state["points"]]
        self._rounds = [Round(*row) for row in state["rounds"]]

    def run(self, on_round: Callable[[Round], None], save_every_s: float) -> None:
        """Fly the remaining episodes; ``on_round`` is called after every round."""
        every = max(1, self.plan.episodes // self.learner.worlds // _CURVE_POINTS) * self.learner.worlds
        saved = time.monotonic()
        with SummaryWriter(str(self._out / TENSORBOARD), purge_step=self.episodes + 1) as board:
            while self.episodes < self.plan.episodes:
                flown = self.learner.round()
                self._rounds.append(flown)
                self.episodes += self.learner.worlds
                for name, value in flown._asdict().items():
                    board.add_scalar(f"training/{name}", value, self.episodes)
                if self.episodes % every == 0 or self.episodes == self.plan.episodes:
                    self._measure()
                    board.add_scalar("held_out/lost_packets", self.points[-1].greedy_lost_packets, self.episodes)
                on_round(flown)
                if time.monotonic() - saved >= save_every_s or self.episodes == self.plan.episodes:
                    self.save()
                    saved = time.monotonic()

    def save(self) -> None:
        """Write the state from which the training resumes."""
        state = {
            "plan": self.plan.plain(),
            "learner": self.learner.state(),
            "random": torch.get_rng_state(),
            "episodes": self.episodes,
            "points": [asdict(point) for point in self.points],
            "rounds": [tuple(row) for row in self._rounds],
        }
        checkpoint.write(state, self._out / STATE)

    def _measure(self) -> None:
        lost = lost_packets(self.plan.scenario, self.learner.network, _HELD_OUT)
        loss, flown, reward = (sum(column) / len(self._rounds) for column in zip(*self._rounds, strict=True))
        self.points.append(Point(self.episodes, flown, reward, loss, float(lost.mean())))
        self._rounds.clear()


def _remedy(name: str, saved: object) -> str:
    return ": give the same scenario" if name == "scenario" else f", which began with {saved}"
