"""One mission flown by a local policy."""

from collections.abc import Callable, Sequence

from simulator.flying.job import BASELINES
from simulator.policies.policy import LearningPolicy, Policy
from simulator.policies.registry import policy_named
from simulator.sites.site import Site
from simulator.world.environment import PipelineWorld
from simulator.world.observation import StepTally


def baselines(site: Site, seed: int, steps: int, names: Sequence[str] = BASELINES) -> dict[str, list[StepTally]]:
    """Local policies, by default the paper's EOF and WQCS, on the same site and seed.

    Returns:
        The tallies of the first ``steps`` steps by policy.
    """
    flown = {name: rollout(site.world(), policy_named(name), seed) for name in names}
    return {name: tally[:steps] for name, tally in flown.items()}


def rollout(
    world: PipelineWorld, policy: Policy, seed: int, on_step: Callable[[StepTally], None] | None = None
) -> list[StepTally]:
    """Fly one mission from ``reset(seed)`` to its end; UAV 0 decides first, and later UAVs know the sensors taken.

    Args:
        world: this function resets it with the seed.
        policy: this function resets it with the world's scenario and the seed.
        seed: of the world, and of a random policy.
        on_step: called after every step with its tally; the world's state is the one after the step.

    Returns:
        The world's tally, one entry a step.
    """
    observations, _ = world.reset(seed=seed)
    policy.reset(world.scenario, seed)
    while world.agents:
        actions: dict[str, tuple[int, int]] = {}
        taken: frozenset[int] = frozenset()
        step, live = len(world.tally), dict(world.live)
        for agent, uav in live.items():
            actions[agent] = policy.decide(uav, observations[agent], taken)
            taken |= {actions[agent][0]}
        observations, _, _, _, infos = world.step(actions)
        if isinstance(policy, LearningPolicy):
            for agent, uav in live.items():
                policy.learn(uav, step, infos[agent]["failed"])
        if on_step is not None:
            on_step(world.tally[-1])
    return list(world.tally)
