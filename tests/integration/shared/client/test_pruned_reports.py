"""Pruning on board agrees with the edge's attention on the UAV's own knowledge, and needs only numpy."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any, get_args

import httpx
import numpy as np
import pytest

from service.api.mission_answers import attention_of, status_of
from service.config.settings import Settings
from service.edge.feedback import LearningQueue
from service.learning.modules import top_k
from service.mission.mission import Mission
from shared.client.edge_client import EdgeClient
from shared.client.pruned_reports import REFRESH_STEPS, AttentionWeights, PrunedReports
from shared.features.augmented_state import FEATURES
from shared.wire.missions import MissionAttention
from shared.wire.schemas import Belief, Features, FeedbackRequest, MissionSpec, Outcome
from shared.world.scenario import SCENARIOS
from simulator.world.environment import PipelineWorld
from simulator.world.observation import decide_request

Edge = Callable[..., httpx.Client]
PAPER = SCENARIOS["paper"]


@pytest.mark.parametrize("n", [1, 2, 10, 700])
@pytest.mark.parametrize("features", get_args(Features))
def test_the_same_features_have_the_same_scores(features: Features, n: int) -> None:
    mission = Mission("test", MissionSpec(features=features), Settings(mode="value"))
    published = MissionAttention.model_validate_json(attention_of(mission).model_dump_json())
    x = np.random.default_rng(n).random((n, FEATURES[features]), dtype=np.float32)
    expected = mission.learner.weights.attend(x).scores
    scores = AttentionWeights.of(published).scores(x)
    assert scores.shape == (n,) and np.abs(scores - expected).max() < 1e-5
    assert np.argsort(-scores, kind="stable")[:5].tolist() == top_k(expected, 5)


@pytest.mark.parametrize("belief", get_args(Belief))
@pytest.mark.parametrize("features", get_args(Features))
def test_a_lone_uav_selects_the_edges_sensors(
    edge: Edge, features: Features, belief: Belief, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A single UAV knows all that the edge knows: from full reports, the edge ranks the sensors alike."""
    # The learning ends before the weights are fetched, so the fetched ones are those that decide.
    monkeypatch.setattr(LearningQueue, "add", LearningQueue._train)
    scenario = PAPER.model_copy(update={"uavs": 1, "steps": 10})
    world, reports = PipelineWorld(scenario), PrunedReports()
    observations, _ = world.reset(seed=3)
    outcome: Outcome | None = None
    compared = 0
    with EdgeClient(str(edge().base_url)) as client:
        client.put_mission(
            "m", MissionSpec(scenario=scenario, mode="value", features=features, belief=belief, top_k=10)
        )
        reports.store(0, 0, client.mission("m"), None)
        for step in range(scenario.steps):
            if outcome is not None:
                client.feedback(FeedbackRequest(mission_id="m", **outcome.model_dump()))
            fetched = httpx.get(f"{client.base_url}/missions/m/attention").content
            reports.store(0, step, MissionAttention.model_validate_json(fetched), None)
            request = decide_request(0, observations["uav_0"], "m", outcome=outcome)
            kept = reports.encode("m", step, request).sensors
            exchange = client.decide(request)
            answer = exchange.response
            reports.record_answer(request, answer)
            scores = {candidate.sensor_id: candidate.score for candidate in answer.top_k}
            if step:
                # Equal sensors have equal scores, and so no order.
                ranked = [scores[sensor] for sensor in kept.id[: len(scores)]]
                assert np.all(np.diff(ranked) < 1e-5) and len(kept.id) == 10 and not kept.x
                compared += len(set(ranked))
            observations, _, _, _, infos = world.step({"uav_0": np.array([answer.sensor_id, answer.velocity])})
            outcome = exchange.outcome(float(infos["uav_0"]["cost"]), bool(infos["uav_0"]["failed"]))
    assert compared >= 18


def test_weights_are_refreshed_after_some_steps() -> None:
    reports = PrunedReports()
    mission = Mission("m", MissionSpec(), Settings(mode="value"))
    wanted = reports.next_fetch("m", 4, 0)
    assert wanted is not None and wanted.path == "/missions/m"
    reports.store(0, 4, status_of(mission), None)
    wanted = reports.next_fetch("m", 4, 0)
    assert wanted is not None and (wanted.path, wanted.etag) == ("/missions/m/attention", None)
    reports.store(0, 4, attention_of(mission), '"v1"')
    assert all(reports.next_fetch("m", step, 0) is None for step in range(4, 4 + REFRESH_STEPS))
    wanted = reports.next_fetch("m", 4 + REFRESH_STEPS, 0)
    assert wanted is not None and wanted.etag == '"v1"'
    # 304: the weights are still current.
    reports.store(0, 4 + REFRESH_STEPS, None, '"v1"')
    assert reports.next_fetch("m", 5 + REFRESH_STEPS, 0) is None
    # Each UAV fetches them separately, for each mission.
    assert reports.next_fetch("m", 4, 1) is not None and reports.next_fetch("other", 4, 0) is not None


@pytest.mark.parametrize("change", [{"features": "paper"}, {"weights": []}])
def test_weights_that_are_none_are_refused(change: dict[str, Any]) -> None:
    published = attention_of(Mission("m", MissionSpec(features="reach"), Settings(mode="value")))
    with pytest.raises(ValueError, match="no attention of preset"):
        AttentionWeights.of(published.model_copy(update=change))


def test_it_needs_neither_torch_nor_scipy(edge: Edge) -> None:
    code = """
import sys
sys.modules.update(dict.fromkeys(("torch", "scipy", "scipy.special", "ortools"), None))
from shared.world.scenario import SCENARIOS
from shared.client.edge_client import EdgeClient
from simulator.flying.flight import fly
from simulator.flying.pilots import EdgePilot
from simulator.sites.site import Site
scenario = SCENARIOS["paper"].model_copy(update={"steps": 3})
with EdgeClient(sys.argv[1], uplink="pruned") as client:
    pilot = EdgePilot(client, "m", scenario, 0)
    client.put_mission("m", pilot.spec)
    flight = fly(Site(scenario), pilot, 0)
assert pilot.last_error is None, pilot.last_error
print([d.request_bytes for d in flight.decisions], [d.attention_bytes > 0 for d in flight.decisions])
"""
    url = str(edge().base_url)
    done = subprocess.run([sys.executable, "-c", code, url], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    sizes, fetched = (eval(part) for part in done.stdout.replace("] [", "]\n[").splitlines())
    assert min(sizes[:3]) > 600 > max(sizes[3:]) and fetched == [True] * 3 + [False] * 6
