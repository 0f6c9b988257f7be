"""Mode guided: candidates, calibration, and scripted LLMs that are always wrong, always right, or late."""

import asyncio
import re
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi.responses import Response

from service.config.settings import Settings
from service.deciding.attended_state import AttendedState
from service.deciding.deliberation import Deliberation, LlmAdvice
from service.deciding.llm_query import LlmQueries
from service.deciding.rollout_evaluator import Evaluation, evaluate
from service.deciding.rollout_state import RolloutState
from service.deciding.stopwatch import Deadline
from service.learning.trust import CAP, LLM
from service.mission.mission import Mission
from service.prompting.candidates import CandidateSet, velocity_options
from service.prompting.guided_prompt import GuidedTemplate
from service.prompting.prompt import Prompt
from shared.belief.learned_channel import ExpectedLinks
from shared.features.augmented_state import Reach
from shared.wire.schemas import MissionSpec, Outcome
from shared.world.channel import channel_gain_db
from shared.world.step_rule import Action
from shared.world.trajectory import trajectories
from tests.support.missions import PAPER, attended, uav
from tests.support.running import listening, serving
from tests.support.stub_llm import FAULTS, StubLlm, chat_completion, misbehaving, wait_for
from tests.support.waiting import until

Report = Callable[..., dict[str, Any]]
Edge = Callable[..., httpx.Client]

TEMPLATE = GuidedTemplate(PAPER, rows=5, experiences=8, ranked=True)


def guided(**settings: Any) -> Mission:
    return Mission("test", MissionSpec(features="reach"), Settings(mode="guided", llm_adapter="off", **settings))


def deliberation(mission: Mission, step: int = 0) -> tuple[AttendedState, Deliberation]:
    x, y = PAPER.lap_centres[0]
    state = uav(
        step=step, position=(x + PAPER.lap_radius_m, y), x=[x + PAPER.lap_radius_m + 40.0 * i for i in range(6)]
    )
    mission.observe(state, step)
    view = attended(mission, state, step)
    return view, Deliberation.of(view)


def test_every_row_has_four_letters_whose_velocities_rise() -> None:
    view, made = deliberation(guided())
    offer = made.candidates
    assert list(offer.labels) == list("ABCDEFGHIJKLMNOPQRST")
    rows = offer.rows.splitlines()
    assert [row[0] for row in rows] == list("AEIMQ")
    assert all(re.fullmatch(r"[A-Z]\d+,\d+,\d+(-\d+)?", row) for row in rows)
    for place, sensor in enumerate(view.kept_ids):
        pairs = [offer.actions[offer.labels[chr(65 + 4 * place + i)]] for i in range(4)]
        assert {s for s, _ in pairs} == {sensor}
        assert [v for _, v in pairs] == sorted(v for _, v in pairs)


@pytest.mark.parametrize(("rows", "velocities_a_row"), [(1, 4), (5, 4), (6, 3), (10, 2), (20, 1), (100, 1)])
def test_twenty_letters_do_for_any_k(rows: int, velocities_a_row: int) -> None:
    template = GuidedTemplate(PAPER, rows=rows, experiences=0, ranked=True)
    assert template.letters.velocities == velocities_a_row
    assert len(template.labels) <= 20


def test_the_static_block_never_changes_and_the_rest_is_short() -> None:
    mission = guided()
    view, first = deliberation(mission)
    for number in range(12):
        decision_id = f"{number:032x}"
        mission.commit(view.pending(decision_id, Action(1, 7)))
        mission.apply(Outcome(decision_id=decision_id, cost=0.3))
    _, later = deliberation(mission, step=3)
    assert later.prompt.static.encode() == first.prompt.static.encode()
    assert later.prompt.experiences.splitlines()[-1] == "20,0>7:3"


def test_the_velocities_offered_are_spread_over_what_serves_the_sensor() -> None:
    distance = np.full((15, 1), 50.0)
    reach = Reach.of(ExpectedLinks.by_formula(distance, PAPER), np.array([30.0]), np.array([0.5]))
    assert velocity_options(reach, 0, 4) == [0, 5, 9, 14]
    assert velocity_options(reach, 0, 1) == [14]
    distance[:3] = distance[12:] = 1e9
    reach = Reach.of(ExpectedLinks.by_formula(distance, PAPER), np.array([30.0]), np.array([0.5]))
    assert velocity_options(reach, 0, 4) == [3, 6, 8, 11]


def test_a_velocity_that_moves_nine_tenths_of_the_most_packets_is_offered() -> None:
    reach = Reach.of(ExpectedLinks.by_formula(np.full((5, 1), 50.0), PAPER), np.array([30.0]), np.array([0.5]))
    reach = replace(reach, packets=np.array([[26.9], [27.0], [30.0], [27.1], [20.0]]))
    assert velocity_options(reach, 0, 3) == [1, 2, 3]


def test_an_experience_has_its_cost_in_tenths_of_two_digits_at_most() -> None:
    seen = {"queue": "20", "age": "0"}
    lines = [TEMPLATE.experience(seen, Action(1, 7), cost, failed=True) for cost in (9.9, 10.0, 13.0)]
    assert lines == ["20,0>7:99\n"] * 3


def test_the_critic_sees_what_is_lost_by_flying_away_from_a_full_queue() -> None:
    mission = guided()
    start = trajectories(PAPER)[0].at(0.0)
    near = [float(start[0]) - 20.0]
    state = uav(position=(float(start[0]), float(start[1])), x=near, queue=[60.0])
    state.sensors.y[0] = float(start[1])
    mission.observe(state, 0)
    situation = RolloutState.of(mission.belief, PAPER, 0, 0)
    judged = evaluate(situation, [Action(0, 0), Action(1, 0)])
    assert judged.lost[1] > judged.lost[0] + 1
    # Sensor 1 was never reported: nothing can be collected from it.
    assert judged.cost[1] >= 1.0 > judged.cost[0]


def test_a_plan_is_judged_by_its_own_continuation_and_never_below_look_ahead() -> None:
    """Two sensors in reach of each other and one across the lap: to dwell pays, where look-ahead flies away."""
    mission = guided()
    places = np.array([trajectories(PAPER)[0].at(metres) for metres in (0.0, 1300.0, 1500.0)])
    state = uav(position=(places[0, 0], places[0, 1]), x=places[:, 0].tolist(), queue=[40.0, 58.0, 58.0])
    state.sensors.y[:] = places[:, 1].tolist()
    assert state.sensors.channel_gain is not None
    state.sensors.channel_gain[:] = channel_gain_db(np.hypot(*(places - places[0]).T), PAPER).tolist()
    mission.observe(state, 0)

    def lost(course: list[Action] | None) -> float:
        plan = None if course is None else {0: course}
        return float(evaluate(RolloutState.of(mission.belief, PAPER, 0, 0, plans=plan), [Action(0, 0)]).lost[0])

    pairs = [(0, 0), (2, 0), (0, 0), (2, 0), (2, 14), (0, 14), (0, 7), (2, 14)]
    dwells = [Action(*pair) for pair in pairs]
    assert lost(dwells) < lost(None) - 1.0
    assert lost([Action(0, 0)] * 8) == lost(None)


def test_a_sensor_never_heard_may_hold_anything_that_the_world_draws() -> None:
    mission = guided()
    state = uav(x=[PAPER.lap_centres[0][0], PAPER.lap_centres[0][0] + 9.0], queue=[39.0, None])
    mission.observe(state, 0)
    situation = RolloutState.of(mission.belief, PAPER, 0, 0)
    assert situation.unknown.tolist() == [False, True]


def planned(mission: Mission, view: AttendedState) -> Action:
    """Let the mission's planner plan."""
    assert mission.planner is not None
    with ThreadPoolExecutor(1) as beside:
        asyncio.run(mission.planner.plan([view.uav_id], (), 10.0, beside))
    action = mission.planner.action(view.uav_id)
    assert action is not None
    return action


@pytest.mark.parametrize(("lost", "flown"), [(0.0, True), (7.0, True), (9.0, False)])
def test_a_plan_is_overruled_only_where_the_critic_sees_a_disaster(lost: float, flown: bool) -> None:
    mission = guided(planner="on")
    view, _ = deliberation(mission)
    plan = planned(mission, view)
    made = Deliberation.of(view)
    place = made.candidates.actions.index(plan)
    losses = np.zeros(len(made.candidates.actions))
    losses[place] = lost
    verdict = made.conclude(mission.trust["stub"], Evaluation(losses, losses), None, calibrated=False)
    assert verdict is not None
    assert (verdict.action == plan) == flown


@pytest.mark.parametrize("answer", ["worst", "random"])
def test_a_bad_llm_cannot_talk_the_fleet_out_of_its_plan(answer: str) -> None:
    mission = guided(planner="on")
    trust, random = mission.trust["stub"], np.random.default_rng(0)
    for step in range(6):
        view, _ = deliberation(mission, step)
        plan = planned(mission, view)
        made = Deliberation.of(view)
        judgement = made.evaluate()
        labels = made.candidates.labels
        worst = max(labels, key=lambda name: judgement.lost[labels[name]])
        reported = worst if answer == "worst" else str(random.choice(list(labels)))
        word = np.array(list(made.candidates.by_action({name: float(name == reported) for name in labels}).values()))
        verdict = made.conclude(trust, judgement, word, calibrated=False)
        assert verdict is not None and verdict.action == plan
        assert set(verdict.report.trust) == {"llm", "planner", "value", "policy"}


def learned(answer: Callable[[Deliberation, np.ndarray], str]) -> float:
    mission = guided(planner="off")
    trust = mission.trust["stub"]
    for step in range(15):
        _view, made = deliberation(mission, step)
        judgement = made.evaluate()
        label = answer(made, judgement.lost)
        word = np.array(
            list(made.candidates.by_action({name: float(name == label) for name in made.candidates.labels}).values())
        )
        verdict = made.conclude(trust, judgement, word, calibrated=False)
        assert verdict is not None
        decision_id = f"{step:032x}"
        trust.open[decision_id] = verdict.advice
        trust.settle(decision_id, verdict.advice.expected_cost)
    return trust.weights[LLM]


def test_trust_falls_for_the_worst_and_not_for_the_best() -> None:
    def worst(made: Deliberation, lost: np.ndarray) -> str:
        return max(made.candidates.labels, key=lambda name: lost[made.candidates.labels[name]])

    def best(made: Deliberation, lost: np.ndarray) -> str:
        return min(made.candidates.labels, key=lambda name: lost[made.candidates.labels[name]])

    assert learned(worst) < 0.05
    assert learned(best) > 0.5


def test_a_disaster_is_not_flown_even_before_trust_has_learned() -> None:
    mission = guided()
    _view, made = deliberation(mission)
    judgement = made.evaluate()
    worst = max(made.candidates.labels, key=lambda name: judgement.lost[made.candidates.labels[name]])
    assert judgement.lost.max() - judgement.lost.min() > 8
    reported = np.array(
        list(made.candidates.by_action({name: float(name == worst) for name in made.candidates.labels}).values())
    )
    verdict = made.conclude(mission.trust["stub"], judgement, reported, calibrated=False)
    assert verdict is not None
    assert verdict.action != made.candidates.actions[made.candidates.labels[worst]]


def test_in_an_advisers_regret_no_candidate_counts_for_more_than_the_cap() -> None:
    mission = guided(planner="off")
    _view, made = deliberation(mission)
    lost = np.full(len(made.candidates.actions), 50.0)
    lost[0] = 0.0
    verdict = made.conclude(mission.trust["stub"], Evaluation(lost, lost), None, calibrated=False)
    assert verdict is not None and verdict.action == made.candidates.actions[0]
    for name, probabilities in made.advised.items():
        assert verdict.advice.regret[name] == pytest.approx(CAP * (1.0 - probabilities[0]))
        assert verdict.advice.flown[name] == pytest.approx(probabilities[0])


def test_what_others_got_meanwhile_is_not_flown() -> None:
    mission = guided()
    _view, made = deliberation(mission)
    trust, judgement = mission.trust["stub"], made.evaluate()
    first = made.conclude(trust, judgement, None, calibrated=False)
    assert first is not None
    second = made.conclude(trust, judgement, None, calibrated=False, reserved={first.action[0]})
    assert second is not None and second.action[0] != first.action[0]
    everything = {sensor for sensor, _ in made.candidates.actions}
    assert made.conclude(trust, judgement, None, calibrated=False, reserved=everything) is None


class Chooser(StubLlm):
    """Says one label whatever it is asked, with probabilities if it tells any; A where the rows say nothing."""

    def __init__(self, answer: str, tells: bool) -> None:
        super().__init__(answer)
        self.tells = tells

    async def respond(self, body: dict[str, Any], probed: bool) -> Response:
        text = "A" if set("?/") & set(body["messages"][-1]["content"]) else self.answer
        usage = {"prompt_tokens": 300, "completion_tokens": 1}
        if not (self.tells and body.get("logprobs")):
            return chat_completion(text, usage)
        likeliest = [{"token": text, "logprob": -0.1}, {"token": "B", "logprob": -2.5}]
        return chat_completion(
            text, usage, logprobs={"content": [{"token": text, "logprob": -0.1, "top_logprobs": likeliest}]}
        )


@pytest.mark.parametrize("tells", [True, False])
def test_decides_and_says_how(edge: Edge, report: Report, tells: bool) -> None:
    model = Chooser("A", tells)
    with serving(model.app) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1")
        assert wait_for(client, "ready")["decides"] == "guided"
        answer = client.post("/decide", json=report()).json()
        again: dict[str, Any] = {}

        def calibrated() -> bool:
            again.update(client.post("/decide", json=report(step=1)).json())
            return again["guided"]["calibrated"] or not tells

        until(calibrated)
        metrics = client.get("/metrics").text
    assert (answer["source"], answer["reason"], answer["model"]) == ("guided", None, "stub-1")
    shown = answer["guided"]
    assert set(shown["trust"]) == {"llm", "planner", "value", "policy"}
    assert sum(shown["trust"].values()) == pytest.approx(1.0, abs=1e-3)
    best = shown["candidates"][0]
    assert (best["sensor_id"], best["velocity"]) == (answer["sensor_id"], answer["velocity"])
    scores = [candidate["score"] for candidate in shown["candidates"]]
    assert scores == sorted(scores, reverse=True) and len(scores) <= 5
    assert (shown["calibrated"], again["guided"]["calibrated"]) == (False, tells)
    assert "aicvds_llm_trust_count" in metrics
    asked = [body for body in model.bodies if body["messages"][-1]["content"] != "Say hello."][1:]
    assert all(body["max_tokens"] == 1 for body in asked)
    assert len({body["messages"][0]["content"] for body in asked}) == 1


def test_an_adapters_advice_is_sharpened(edge: Edge, report: Report) -> None:
    """The stub gives label A ten times the probability of B, and the others half of B's each."""
    highest = {}
    for form in ("csv", "compact"):
        with serving(Chooser("A", tells=True).app) as url:
            client = edge(mode="guided", llm_url=f"{url}/v1", llm_adapter="served")
            wait_for(client, "ready")
            made = client.put("/missions/own", json={"prompt": {"format": form}})
            assert made.is_success, made.text
            answer = client.post("/decide", json={**report(), "mission_id": "own"}).json()
        highest[form] = max(candidate["llm"] or 0.0 for candidate in answer["guided"]["candidates"])
    assert highest["csv"] < 0.7 and highest["compact"] > 0.95


@pytest.mark.parametrize("fault", ["silent", "resetting", "500", "no text"])
def test_without_the_llm_the_others_decide(
    edge: Edge, report: Report, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    handler, reason = FAULTS[fault]
    if reason == "llm_timeout":
        # The LLM has a moment, and the rollout evaluator its whole minute.
        ask = LlmQueries.ask

        async def briefly(
            self: LlmQueries, mission: Mission, candidates: CandidateSet, prompt: Prompt, deadline: Deadline
        ) -> LlmAdvice:
            return await ask(self, mission, candidates, prompt, Deadline(time.perf_counter() + 0.2))

        monkeypatch.setattr(LlmQueries, "ask", briefly)
    with listening(misbehaving(handler)) as url:
        client = edge(mode="guided", llm_url=f"{url}/v1", llm_model="stub-1")
        wait_for(client, "ready")
        answer = client.post("/decide", json=report()).json()
    assert (answer["source"], answer["reason"], answer["model"]) == ("policy", reason, None)
    assert answer["guided"]["candidates"][0]["llm"] is None
    assert answer["guided"]["trust"] == {"llm": 0.2, "planner": 0.6, "value": 0.1, "policy": 0.1}


@pytest.mark.parametrize(("paid", "rises"), [(0.0, True), (1.0, False)])
def test_a_mission_learns_whom_to_trust_from_what_comes_back(
    edge: Edge, report: Report, paid: float, rises: bool
) -> None:
    """Whether what the LLM talked the fleet into succeeds: the same decisions, another outcome, another trust."""
    trust = []
    with serving(Chooser("A", tells=False).app) as url:
        for cost in (paid, 0.5):
            client = edge(mode="guided", llm_url=f"{url}/v1", planner="off")
            wait_for(client, "ready")
            first = client.post("/decide", json=report(step=0)).json()
            outcome = {"decision_id": first["decision_id"], "cost": cost}
            second = client.post("/decide", json=report(step=1, outcome=outcome)).json()
            trust.append(second["guided"]["trust"]["llm"])
            followed = first["guided"]["candidates"][0]["llm"]
    assert followed is not None
    # The LLM gave more than its share to what was flown, or less.
    believed = followed > first["guided"]["candidates"][0]["mixture"]
    assert (trust[0] > trust[1]) == (rises == believed)


def test_another_mode_says_nothing_of_trust(edge: Edge, report: Report) -> None:
    assert edge().post("/decide", json=report()).json()["guided"] is None
