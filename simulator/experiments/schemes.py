"""Schemes: who decides for the fleet in an experiment, and what people call them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from shared.wire import MissionSpec
from simulator.experiments.operators import Operator
from simulator.records.record import Record

# Decisions through an edge are compared for what they are, not for how fast this machine is.
GENEROUS_DEADLINE_MS = 30_000

# What answers behind an edge: nothing, what --llm names, uniform draws, the worst of what is offered, or a model file
# by its path.
Backing = str
OFF, ASKED, CHANCE, WORST = "off", "asked", "chance", "worst"


class Local(Record):
    """A policy of the simulator's own; ``velocity`` is the policy's or the scenario's highest throughout."""

    kind: Literal["local"] = "local"
    policy: str
    velocity: Literal["own", "full"] = "own"


class OverEdge(Record):
    """An edge asked over HTTP. ``spec`` is the mission to make, its scenario and seed aside.

    ``backing`` is ``off`` (an edge without LLM), ``asked`` (what ``--llm`` names), ``chance`` (an LLM that answers
    uniform draws), ``worst`` (the emptiest queue, as fast as can be) or a GGUF file's path. ``deadline_ms`` of ``None``
    is the edge's own. ``operator`` says what is asked of the fleet in words, if anything is.
    """

    kind: Literal["edge"] = "edge"
    spec: dict[str, Any]
    backing: Backing = ASKED
    deadline_ms: int | None = GENEROUS_DEADLINE_MS
    operator: Operator | None = None


class Clairvoyant(Record):
    """No scheme but the bound to judge them by: the least that a fleet could lose, all arrivals known."""

    kind: Literal["bound"] = "bound"
    seconds: float = 60.0


class Scheme(Record):
    """Who decides, under a name for files and a label for people."""

    name: str
    label: str
    decides: Annotated[Local | OverEdge | Clairvoyant, Field(discriminator="kind")]

    @property
    def is_answered(self) -> bool:
        """Whether its decisions are answers of what is behind its edge, and the edge's policy's are not its own."""
        return isinstance(self.decides, OverEdge) and self.decides.backing != OFF

    @property
    def asks_llm(self) -> bool:
        """Whether a flight takes an LLM's time."""
        return self.is_answered and not (isinstance(self.decides, OverEdge) and self.decides.backing in (CHANCE, WORST))


PLANNER = "mpc"
# In the order to show them. Which of them a figure shows depends on which policies this version has.
_POLICY_LABELS = {
    "madqn": "MADQN",
    "mappo": "MAPPO",
    PLANNER: "MPC (CP-SAT, horizon 8)",
    "eof": "EOF",
    "wqcs": "WQCS",
    "max_gain": "maximum channel gain",
    "nearest": "nearest neighbour",
    "round_robin": "round robin",
    "random": "random",
}
BOUND = Scheme(name="bound", label="clairvoyant bound", decides=Clairvoyant())


def local(name: str) -> Scheme:
    """The policy of that name."""
    return Scheme(name=name, label=_POLICY_LABELS.get(name, name), decides=Local(policy=name))


def at_full_speed(name: str) -> Scheme:
    """Another policy's sensors at the scenario's highest velocity, to tell scheduling from flying fast."""
    label = f"{_POLICY_LABELS.get(name, name)} at full speed"
    return Scheme(name=f"{name}_fast", label=label, decides=Local(policy=name, velocity="full"))


def locals_there_are(*names: str) -> list[Scheme]:
    """Those of ``names`` that this version of the simulator has, in the order to show them; of no names, all."""
    from simulator.policies.registry import POLICY_NAMES

    wanted = names or (*_POLICY_LABELS, *(name for name in POLICY_NAMES if name not in _POLICY_LABELS))
    return [local(name) for name in wanted if name in POLICY_NAMES]


def over_edge(
    name: str,
    label: str,
    *,
    backing: Backing = ASKED,
    deadline_ms: int | None = GENEROUS_DEADLINE_MS,
    operator: Operator | None = None,
    **spec: Any,
) -> Scheme:
    """An edge whose mission has the ``spec`` fields given; 5 sensors kept and mode ``llm`` unless told.

    Raises:
        pydantic.ValidationError: the spec is no mission's.
    """
    whole = MissionSpec.model_validate({"mode": "llm", "top_k": 5, **spec})
    kept = whole.model_dump(mode="json", exclude_defaults=True, exclude={"scenario", "seed"})
    decides = OverEdge(spec=kept, backing=backing, deadline_ms=deadline_ms, operator=operator)
    return Scheme(name=name, label=label, decides=decides)


def llm() -> Scheme:
    """The paper's method."""
    return over_edge("llm", "AIC-VDS, mode llm")


def guided(name: str = "guided", label: str = "AIC-VDS, mode guided", **spec: Any) -> Scheme:
    """The LLM as one adviser among others."""
    return over_edge(name, label, mode="guided", **spec)


def value_as_written(name: str = "value", label: str = "AIC-VDS, mode value, paper's view", **spec: Any) -> Scheme:
    """What the edge's modules have learned decides, from the paper's features and each UAV's own reports; no LLM."""
    return over_edge(name, label, mode="value", features="paper", belief="reported", backing=OFF, **spec)


def value() -> Scheme:
    """The same with features that look along the trajectory, from the fleet's belief."""
    return over_edge("value_reach", "AIC-VDS, mode value", mode="value", backing=OFF)


def edge_planner() -> Scheme:
    """What the edge answers while its LLM is down."""
    return over_edge("edge_planner", "edge's planner (LLM down)", mode="policy", backing=OFF)


def edge_policy() -> Scheme:
    """The same where the planner is not installed, from each UAV's own reports."""
    return over_edge("edge_policy", "edge's look-ahead (no planner)", planner="off", backing=OFF)


def every_scheme() -> list[Scheme]:
    """All that can fly, in the order to show them."""
    ours = [llm(), guided(), value_as_written(), value(), edge_policy(), edge_planner()]
    return [*ours, *locals_there_are(), at_full_speed("eof"), at_full_speed("wqcs")]
