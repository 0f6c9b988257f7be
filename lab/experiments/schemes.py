"""The schemes of experiments: deciders for the fleet, with their names and labels."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from lab.experiments.operators import Operator
from lab.experiments.uplinks_of_sensors import UplinkPlan
from shared.wire.schemas import MissionSpec
from simulator.records.decision import Record

# So long that the speed of this machine does not change an edge's decisions.
GENEROUS_DEADLINE_MS = 30_000

# The LLM behind an edge: none, that of --llm, the embedded one with its adapter, uniform draws, uniform draws of the
# answers that the adapter's prompt allows, the worst of the candidates, or a model file by its path.
Backing = str
OFF, NAMED_BY_OPTION, ADAPTED = "off", "asked", "adapted"
CHANCE, CHANCE_AS_ADAPTED, WORST = STAND_INS = "chance", "chance as adapted", "worst"


class Local(Record):
    """A local policy; ``velocity`` is the policy's own, or the scenario's highest throughout."""

    kind: Literal["local"] = "local"
    policy: str
    velocity: Literal["own", "full"] = "own"


class OverEdge(Record):
    """An edge over HTTP. ``spec`` is its mission's, without scenario and seed.

    ``backing`` is ``off`` (no LLM), ``asked`` (the LLM of ``--llm``), ``adapted`` (the embedded LLM with the adapter of
    ``AICVDS_LLM_ADAPTER``, by default the package's), ``chance`` (an LLM that answers uniform draws), ``chance as
    adapted`` (one that gets the adapter's prompt), ``worst`` (the emptiest queue at the highest velocity) or a GGUF
    file's path. ``deadline_ms`` of ``None`` is the edge's default. ``operator`` guides the fleet, if set. With
    ``sensor_uplinks`` some sensors report to the edge themselves.
    """

    kind: Literal["edge"] = "edge"
    spec: dict[str, Any]
    backing: Backing = NAMED_BY_OPTION
    deadline_ms: int | None = GENEROUS_DEADLINE_MS
    operator: Operator | None = None
    sensor_uplinks: UplinkPlan | None = None


class Clairvoyant(Record):
    """The clairvoyant bound, a reference for all schemes: the least that a fleet could lose, all arrivals known."""

    kind: Literal["bound"] = "bound"
    seconds: float = 60.0


class Informed(Record):
    """The planner with every true link, a reference: see ``lab.experiments.informed_planner``."""

    kind: Literal["informed"] = "informed"


class Scheme(Record):
    """A decider, with a name for files and a label for display."""

    name: str
    label: str
    decides: Annotated[Local | OverEdge | Clairvoyant | Informed, Field(discriminator="kind")]

    @property
    def is_answered(self) -> bool:
        """Whether its decisions are those of its edge's backing, so that decisions of the edge's policy are not."""
        return isinstance(self.decides, OverEdge) and self.decides.backing != OFF

    @property
    def asks_llm(self) -> bool:
        """Whether its flights query a real LLM."""
        return self.is_answered and not (isinstance(self.decides, OverEdge) and self.decides.backing in STAND_INS)


PLANNER, FORMULA_PLANNER = "mpc", "mpc_formula"
PLANNERS = (PLANNER, FORMULA_PLANNER)
# In display order. A figure shows those that are policies of this version.
_POLICY_LABELS = {
    "madqn": "MADQN",
    "madqn_paper": "MADQN, the paper's",
    "mappo": "MAPPO",
    PLANNER: "MPC (horizon 8)",
    FORMULA_PLANNER: "MPC without learning",
    "eof": "EOF",
    "wqcs": "WQCS",
    "eof_coordinated": "EOF, coordinated",
    "wqcs_coordinated": "WQCS, coordinated",
    "longest_queue": "longest queue",
    "queue_and_channel": "queue and channel",
    "max_gain": "maximum channel gain",
    "nearest": "nearest neighbour",
    "round_robin": "round robin",
    "random": "random",
}
_OF_THE_LAB = {name: f"lab.marl.learned:{name}" for name in ("madqn", "madqn_paper", "mappo")}
_OF_THE_LAB[FORMULA_PLANNER] = "lab.experiments.formula_planner:FormulaPlanner"
# Only the experiments that name them fly these.
_NAMED_ONLY = (FORMULA_PLANNER,)
BOUND = Scheme(name="bound", label="clairvoyant bound", decides=Clairvoyant())
INFORMED = Scheme(name="informed", label="MPC, told the true links", decides=Informed())


def local(name: str) -> Scheme:
    """The policy of that name."""
    return Scheme(name=name, label=_POLICY_LABELS.get(name, name), decides=Local(policy=_OF_THE_LAB.get(name, name)))


def at_full_speed(name: str) -> Scheme:
    """Another policy's sensors at the scenario's highest velocity, to separate scheduling from speed."""
    label = f"{_POLICY_LABELS.get(name, name)} at full speed"
    return Scheme(name=f"{name}_fast", label=label, decides=Local(policy=name, velocity="full"))


def available_locals(*names: str) -> list[Scheme]:
    """The local policies of ``names`` that this version has, in display order; without names, all but variants."""
    from simulator.policies.registry import POLICY_NAMES

    known = {*_OF_THE_LAB, *POLICY_NAMES}
    every = (*_POLICY_LABELS, *(name for name in POLICY_NAMES if name not in _POLICY_LABELS))
    chosen = names or tuple(name for name in every if name not in _NAMED_ONLY)
    return [local(name) for name in chosen if name in known]


def over_edge(
    name: str,
    label: str,
    *,
    backing: Backing = NAMED_BY_OPTION,
    deadline_ms: int | None = GENEROUS_DEADLINE_MS,
    operator: Operator | None = None,
    sensor_uplinks: UplinkPlan | None = None,
    **spec: Any,
) -> Scheme:
    """An edge whose mission has the given ``spec`` fields; by default k is 5 and the mode is ``llm``.

    Raises:
        pydantic.ValidationError: the spec is invalid.
    """
    whole = MissionSpec.model_validate({"mode": "llm", "top_k": 5, **spec})
    fields = whole.model_dump(mode="json", exclude_defaults=True, exclude={"scenario", "seed"})
    decides = OverEdge(
        spec=fields, backing=backing, deadline_ms=deadline_ms, operator=operator, sensor_uplinks=sensor_uplinks
    )
    return Scheme(name=name, label=label, decides=decides)


def llm() -> Scheme:
    """The paper's method."""
    return over_edge("llm", "AIC-VDS, mode llm")


def adapted_llm(name: str = "llm_adapted", label: str = "mode llm, with the adapter", **options: Any) -> Scheme:
    """The embedded LLM with its adapter; neither planner nor verifier takes part."""
    return over_edge(name, label, **{"backing": ADAPTED, "verify": "off", "planner": "off"} | options)


def adapted_chance() -> Scheme:
    """Uniform draws of the answers between which the LLM with its adapter chooses, from the same prompts."""
    return adapted_llm("llm_chance", "uniform draws in place of the LLM with its adapter", backing=CHANCE_AS_ADAPTED)


def guided(name: str = "guided", label: str = "AIC-VDS, mode guided", **spec: Any) -> Scheme:
    """The LLM as one adviser among others."""
    return over_edge(name, label, mode="guided", **spec)


def value_as_written(name: str = "value", label: str = "AIC-VDS, mode value, paper's view", **spec: Any) -> Scheme:
    """The edge's learned modules without an LLM, with the paper's features and each UAV's own reports."""
    return over_edge(name, label, mode="value", features="paper", belief="reported", backing=OFF, **spec)


def value() -> Scheme:
    """The edge's learned modules without an LLM, with features along the trajectory from the fleet's belief."""
    return over_edge("value_reach", "AIC-VDS, mode value", mode="value", backing=OFF)


def edge_planner(name: str = "edge_planner", label: str = "edge's planner (LLM down)", **options: Any) -> Scheme:
    """The edge's planner, which decides while the LLM is down."""
    return over_edge(name, label, mode="policy", backing=OFF, **options)


def edge_policy() -> Scheme:
    """The edge's look-ahead, which decides without the planner, from each UAV's own reports."""
    return over_edge("edge_policy", "edge's look-ahead (no planner)", planner="off", backing=OFF)


def every_scheme() -> list[Scheme]:
    """All schemes that can fly, in display order."""
    ours = [llm(), guided(), value_as_written(), value(), edge_policy(), edge_planner()]
    return [*ours, *available_locals(), *map(at_full_speed, ("longest_queue", "queue_and_channel"))]
