"""The planner in the edge: it decides where no LLM does, for the whole fleet, from what the fleet knows."""

from __future__ import annotations

import builtins
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from service.mission import planner
from shared.world.scenario import SCENARIOS, Scenario
from simulator.policies.mpc import RecedingHorizonPolicy
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request

Edge = Callable[..., httpx.Client]
SHORT = SCENARIOS["paper"].model_copy(update={"steps": 6})


def body(request: Any) -> dict[str, Any]:
    return dict(request.model_dump(mode="json", exclude_none=True))


def batch_of(scenario: Scenario) -> dict[str, Any]:
    """The reports of all UAVs at step 0."""
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=1000)
    uavs = []
    for uav, agent in enumerate(world.agents):
        state = body(decide_request(uav, observations[agent], "test"))
        uavs.append({key: value for key, value in state.items() if key not in ("mission_id", "step", "deadline_ms")})
    return {"mission_id": "test", "step": 0, "deadline_ms": 60_000, "uavs": uavs}


def flown_by_edge(client: httpx.Client, scenario: Scenario, seed: int) -> list[list[tuple[int, int]]]:
    world = PipelineWorld(scenario)
    observations, _ = world.reset(seed=seed)
    flown = []
    while world.agents:
        step = []
        for uav, agent in enumerate(world.agents):
            answer = client.post("/decide", json=body(decide_request(uav, observations[agent], "test"))).json()
            assert (answer["source"], answer["reason"]) == ("policy", "mode_policy")
            step.append((answer["sensor_id"], answer["velocity"]))
        flown.append(step)
        actions = {agent: np.array(action) for agent, action in zip(world.agents, step, strict=True)}
        observations, *_ = world.step(actions)
    return flown


def flown_by_planner(scenario: Scenario, seed: int) -> list[list[tuple[int, int]]]:
    world, policy = PipelineWorld(scenario), RecedingHorizonPolicy()
    observations, _ = world.reset(seed=seed)
    policy.reset(scenario, seed)
    flown = []
    while world.agents:
        step: list[tuple[int, int]] = []
        for uav, agent in enumerate(world.agents):
            step.append(policy.decide(uav, observations[agent], frozenset(sensor for sensor, _ in step)))
        flown.append(step)
        actions = {agent: np.array(action) for agent, action in zip(world.agents, step, strict=True)}
        observations, *_ = world.step(actions)
    return flown


def test_mode_policy_flies_as_the_planner_of_the_simulator_does(edge: Edge) -> None:
    client = edge(mode="policy", planner_ms=60_000)
    assert client.put("/missions/test", json={"scenario": SHORT.model_dump(mode="json")}).json()["planner"] == "on"
    assert client.get("/readyz").json()["llm"] == "off"
    assert flown_by_edge(client, SHORT, 1000) == flown_by_planner(SHORT, 1000)


def test_without_the_planner_the_policy_looks_one_step_ahead(edge: Edge) -> None:
    client = edge(mode="policy")
    spec = {"scenario": SHORT.model_dump(mode="json"), "planner": "off"}
    assert client.put("/missions/test", json=spec).json()["planner"] == "off"
    assert flown_by_edge(client, SHORT, 1000) != flown_by_planner(SHORT, 1000)


def test_a_planner_that_fails_is_no_error_of_the_decision(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def broken(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("numba"):
            raise ImportError("broken library")
        return real(name, *args, **kwargs)

    client = edge(mode="policy")
    monkeypatch.setattr(builtins, "__import__", broken)
    monkeypatch.setitem(__import__("sys").modules, "shared.planning.annealing", None)
    assert len(flown_by_edge(client, SHORT.model_copy(update={"name": "one", "steps": 1}), 0)) == 1


def test_a_fleet_too_large_to_plan_for_is_decided_all_the_same(edge: Edge) -> None:
    large = Scenario(name="large", sensors=planner.MAX_SENSORS + 1, uavs=1, steps=1)
    client = edge(mode="policy")
    made = client.put("/missions/test", json={"scenario": large.model_dump(mode="json")})
    assert made.json()["planner"] == "off"
    assert len(flown_by_edge(client, large, 0)) == 1


def test_the_llm_free_policy_of_mode_llm_is_the_planner(edge: Edge) -> None:
    """With no LLM to be had, the fleet flies as the planner says."""
    client = edge(mode="llm", llm_gguf="none", planner_ms=60_000)
    client.put("/missions/test", json={"scenario": SHORT.model_dump(mode="json")})
    world = PipelineWorld(SHORT)
    observations, _ = world.reset(seed=1000)
    answer = client.post("/decide", json=body(decide_request(0, observations["uav_0"], "test"))).json()
    assert answer["source"] == "policy"
    assert answer["reason"].startswith("llm_")
    assert (answer["sensor_id"], answer["velocity"]) == flown_by_planner(SHORT, 1000)[0][0]


def test_one_uav_decides_from_what_another_heard(edge: Edge) -> None:
    """UAV 1 reports nothing but places: the fleet's belief still knows the full queue beside it."""
    client = edge(mode="value")
    world = PipelineWorld(SHORT)
    observations, _ = world.reset(seed=1000)
    heard = body(decide_request(0, observations["uav_0"], "fleet"))
    client.post("/decide", json=heard)
    deaf = body(decide_request(1, observations["uav_1"], "fleet"))
    count = len(deaf["sensors"]["id"])
    for column in ("queue", "battery", "channel_gain", "last_seen"):
        deaf["sensors"][column] = [None] * count
    alone = client.post("/decide", json=deaf | {"mission_id": "alone"}).json()
    together = client.post("/decide", json=deaf).json()
    assert {c["sensor_id"]: c["score"] for c in together["top_k"]} != {
        c["sensor_id"]: c["score"] for c in alone["top_k"]
    }
    client.put("/missions/reported", json={"belief": "reported"})
    client.post("/decide", json=heard | {"mission_id": "reported"})
    assert client.post("/decide", json=deaf | {"mission_id": "reported"}).json()["reason"] == "no_candidate"


def test_a_batch_is_planned_at_once_from_all_reports(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    plans = []
    real = planner.MissionPlanner.plan

    async def counted(self: planner.MissionPlanner, uavs: Any, *args: Any) -> None:
        plans.append(list(uavs))
        await real(self, uavs, *args)

    monkeypatch.setattr(planner.MissionPlanner, "plan", counted)
    client = edge(mode="policy", planner_ms=60_000)
    client.put("/missions/test", json={"scenario": SHORT.model_dump(mode="json")})
    # A plan that takes longer than the first UAV's share of the time would be made again without it.
    answers = client.post("/decide/batch", json=batch_of(SHORT), timeout=60).json()["decisions"]
    assert plans == [[0, 1, 2]]
    assert len({answer["sensor_id"] for answer in answers}) == 3
    assert {answer["reason"] for answer in answers} == {"mode_policy"}


def test_after_a_uav_that_departs_from_the_plan_the_rest_of_a_batch_is_planned_anew(
    edge: Edge, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the search finds no plan, so that every UAV departs."""
    plans = []

    async def fruitless(self: planner.MissionPlanner, uavs: Any, *args: Any) -> None:
        plans.append(list(uavs))

    monkeypatch.setattr(planner.MissionPlanner, "plan", fruitless)
    client = edge(mode="policy")
    client.put("/missions/test", json={"scenario": SHORT.model_dump(mode="json")}).raise_for_status()
    answers = client.post("/decide/batch", json=batch_of(SHORT)).json()["decisions"]
    assert plans == [[0, 1, 2], [1, 2], [2]]
    assert len({answer["sensor_id"] for answer in answers}) == 3


def test_a_large_batch_is_planned_in_groups(edge: Edge, monkeypatch: pytest.MonkeyPatch) -> None:
    groups = []
    real = planner.MissionPlanner.draft

    def noted(self: planner.MissionPlanner, uavs: Any, taken: Any = ()) -> Any:
        groups.append(list(uavs))
        return real(self, uavs, taken)

    monkeypatch.setattr(planner.MissionPlanner, "draft", noted)
    crowd = SCENARIOS["dense"].model_copy(update={"uavs": 26, "sensors": 120, "steps": 1})
    client = edge(mode="policy", planner_ms=60_000)
    client.put("/missions/test", json={"scenario": crowd.model_dump(mode="json")}).raise_for_status()
    answers = client.post("/decide/batch", json=batch_of(crowd), timeout=60).json()["decisions"]
    assert groups == [list(range(12)), list(range(12, 24)), [24, 25]]
    assert {answer["reason"] for answer in answers} == {"mode_policy"}
    assert len({answer["sensor_id"] for answer in answers}) == 26
