"""Tokens of a decision in the paper's template with and without attention, and their cost in time and quality.

    python -m benchmarks.tokens
    python -m benchmarks.tokens --seeds 30 --asked 3    # more decisions for the LLM: narrower intervals

It flies missions by a planner and makes the prompts of every decision in several forms: those of the edge's modes, and
the paper's with every free and charged sensor that a UAV has heard. It counts whole prompts in tiktoken's o200k_base
and in the embedded model's own tokens, and the tokens that a server with the previous prompt in its cache reads newly.
The embedded model answers some decisions from the middle of each mission: the benchmark measures time, the server's own
account of its cache, and the answers' quality by the edge's rollout evaluator. Intervals are 95% bootstrap intervals
over missions (tokens), decisions (quality) or pairs (times).
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from rich.progress import track

from benchmarks.flown_prompts import CONTEXT, FORMS, GUIDED, LLM, PAPER, FlownDecision, flown
from benchmarks.harness import Cell, Goal, Options, Report, run
from lab.benchmarks.local_llm import LocalLLM, TimedAnswer
from lab.experiments.intervals import interval, paired, ratio_of_medians
from service.config.settings import Settings
from service.deciding.rollout_evaluator import evaluate
from service.llm.answers import NoDecision, check_answer
from service.prompting.token_accounting import TokenCounter
from shared.world.scenario import Scenario, scenario_named
from shared.world.step_rule import Action

GOAL_PROMPT, GOAL_NEW = 0.5, 0.15
# The forms whose answers are judged: an answer is a sensor and a velocity, or a letter for both.
JUDGED = (GUIDED, LLM, PAPER)
# The comparisons of the answers: uniform draws among all sensors of a prompt, and among those that attention keeps.
_DRAWN, _DRAWN_KEPT = "drawn", "drawn_among_kept"
_COUNTS = ("o200k", "own", "new")
# Counts by o200k_base: the whole prompt and its blocks, and their names in the edge's token accounting.
_BLOCKS = {"o200k": "prompt", "o200k_static": "static", "o200k_experiences": "experiences", "o200k_state": "state"}


@dataclass(frozen=True)
class Tokens(Options):
    """Count tokens, time them, and compare with the paper's template."""

    seeds: int = 6
    """Missions: seeds --first to --first + N - 1."""
    first: int = 0
    """The first seed."""
    asked: int = 1
    """Decisions from each mission's middle for the embedded LLM, after one more that fills its cache."""
    policy: Literal["mpc", "eof"] = "mpc"
    """Policy of the missions: the planner, or the rule that is faster to compute."""
    scenario: str = "paper"
    """Scenario of the missions."""
    steps: int | None = None
    """Steps of each mission; by default the scenario's."""
    threads: int = 1
    """Threads of the embedded LLM."""


def measure(args: Tokens) -> Report:
    """Fly, count tokens, and query the LLM."""
    scenario = scenario_named(args.scenario)
    if args.steps is not None:
        scenario = scenario.model_copy(update={"steps": args.steps})
    seeds = range(args.first, args.first + args.seeds)
    flights = [flown(scenario, seed, args.policy).decisions for seed in track(seeds, "Flying")]
    with LocalLLM(args.threads, CONTEXT) as llm:
        tokens, name = token_figures(counted(flights, llm)), llm.name
    found: dict[str, Any] = {
        "options": asdict(args),
        "model": name,
        "decisions": [len(flight) for flight in flights],
        "tokens": tokens,
        "state_tokens_by_step": by_step(flights),
        "asked": answer_figures(llm_answers(flights, scenario, args), scenario),
    }
    ratio = tokens[GUIDED]["ratio"]
    goals = [
        Goal(f"{FORMS[GUIDED]}: tokens to the paper's", ratio["own"], most=GOAL_PROMPT),
        Goal(f"{FORMS[GUIDED]}: newly read to the paper's whole", ratio["new_to_whole"], most=GOAL_NEW),
    ]
    return Report(found, tables(found), goals)


def counted(flights: Sequence[Sequence[FlownDecision]], llm: LocalLLM) -> dict[str, dict[str, list[float]]]:
    """Means of each mission by form and count: tokens by o200k_base, by the model, and new since the last prompt."""
    counter = TokenCounter(Settings().cache_dir)
    means: dict[str, dict[str, list[float]]] = {form: {count: [] for count in (*_COUNTS, *_BLOCKS)} for form in FORMS}
    for flight in track(flights, "Counting"):
        for form in FORMS:
            prompts = [decision.prompts[form].prompt for decision in flight]
            own = [llm.tokens(prompt) for prompt in prompts]
            new = [newly_read(now, before) for now, before in zip(own, [[], *own], strict=False)]
            accounts = [counter.account(prompt) for prompt in prompts]
            for count, name in _BLOCKS.items():
                means[form][count].append(statistics.fmean(getattr(account, name) for account in accounts))
            means[form]["own"].append(statistics.fmean(map(len, own)))
            means[form]["new"].append(statistics.fmean(new))
    return means


def by_step(flights: Sequence[Sequence[FlownDecision]]) -> dict[str, dict[int, list[float]]]:
    """Tokens of the state block by o200k_base: mean and standard deviation by step, and ``all`` without any mask."""
    counter = TokenCounter(Settings().cache_dir)
    found: dict[str, dict[int, list[float]]] = {LLM: {}, PAPER: {}, "all": {}}
    decisions = [decision for flight in flights for decision in flight]
    for step in sorted({decision.step for decision in decisions}):
        prompts = {
            form: [decision.prompts[form].prompt for decision in decisions if decision.step == step]
            for form in (LLM, PAPER)
        }
        counts = {form: [counter.count(prompt.state) for prompt in of_form] for form, of_form in prompts.items()}
        counts["all"] = [counter.account(prompt).state_uncompressed for prompt in prompts[PAPER]]
        for form, own in counts.items():
            found[form][step] = [statistics.fmean(own), statistics.pstdev(own)]
    return found


def newly_read(now: Sequence[int], before: Sequence[int]) -> int:
    """The number of tokens that a server with the previous prompt in its cache reads; the last one always counts."""
    same = next((i for i, (a, b) in enumerate(zip(now, before, strict=False)) if a != b), min(len(now), len(before)))
    return len(now) - min(same, len(now) - 1)


def token_figures(counts: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """Means and ratios to the paper's, by form; ``new_to_whole`` is to the paper's without any prefix cache."""
    theirs = counts[PAPER]
    found: dict[str, Any] = {}
    for form, ours in counts.items():
        found[form] = {count: interval(values).model_dump(exclude={"values"}) for count, values in ours.items()}
        found[form]["ratio"] = {
            **{count: _ratio(ours[count], theirs[count]) for count in _COUNTS},
            "new_to_whole": _ratio(ours["new"], theirs["own"]),
        }
    return found


def _ratio(ours: Sequence[float], theirs: Sequence[float]) -> list[float]:
    of_means = next(pair for pair in paired("ours", "theirs", "tokens", ours, theirs) if pair.kind == "ratio")
    return [of_means.mean, of_means.low, of_means.high]


@dataclass(frozen=True)
class DecisionAnswer:
    """One answer to a decision's prompt in one form; ``expected_new`` is the expected number of newly read tokens.

    It is None for the first answer of each mission, when the cache has another mission's prompt.
    """

    decision: FlownDecision
    answer: TimedAnswer
    expected_new: int | None


def llm_answers(
    flights: Sequence[Sequence[FlownDecision]], scenario: Scenario, args: Tokens
) -> dict[str, list[DecisionAnswer]]:
    """The embedded LLM's answers in each form of ``JUDGED``; the forms alternate, each with a server of its own."""
    middles = [(i > 0, decision) for flight in flights for i, decision in enumerate(middle(flight, args.asked + 1))]
    answers: dict[str, list[DecisionAnswer]] = {form: [] for form in JUDGED}
    before: dict[str, list[int]] = {}
    with ExitStack() as stack:
        models = {form: stack.enter_context(LocalLLM(args.threads, CONTEXT)) for form in JUDGED}
        for warm, decision in track(middles, "Asking"):
            for form, llm in models.items():
                now = llm.tokens(decision.prompts[form].prompt)
                answer = llm.ask(decision.prompts[form].body(scenario.max_velocity + 1))
                expected_new = newly_read(now, before[form]) if warm else None
                answers[form].append(DecisionAnswer(decision, answer, expected_new))
                before[form] = now
    return answers


def middle(flight: Sequence[FlownDecision], count: int) -> Sequence[FlownDecision]:
    """Consecutive decisions from the middle on, with 30 experiences; fewer if the mission is shorter."""
    return flight[len(flight) // 2 :][:count]


def answer_figures(answers: dict[str, list[DecisionAnswer]], scenario: Scenario) -> dict[str, Any]:
    """The figures of the LLM's answers: time, newly read tokens, expected losses."""
    lost = judged(answers, scenario)
    warm = {form: [one for one in given if one.expected_new is not None] for form, given in answers.items()}
    paper_s = [one.answer.seconds for one in warm[PAPER]]
    found: dict[str, Any] = {"decisions": len(answers[PAPER]), "lost_packets_above_best": {}, "compared": []}
    for form, given in warm.items():
        found[form] = {
            "seconds_median": statistics.median(one.answer.seconds for one in given),
            "to_paper_seconds": ratio_of_medians([one.answer.seconds for one in given], paper_s),
            "new_mean": statistics.fmean(one.answer.new for one in given),
            "new_as_reckoned": sum(one.answer.new == one.expected_new for one in given) / len(given),
            "late": sum(one.answer.late for one in given),
        }
    for form, values in lost.items():
        found["lost_packets_above_best"][form] = interval(values).model_dump()
        if form != PAPER:
            found["compared"] += [pair.model_dump() for pair in paired(form, PAPER, "lost", values, lost[PAPER])]
    return found


def judged(answers: dict[str, list[DecisionAnswer]], scenario: Scenario) -> dict[str, list[float]]:
    """The expected lost packets of the fleet after each answer and after uniform draws, less those after the best one.

    The candidates are all sensors of the prompt at all velocities. An invalid answer loses as much as a draw.
    """
    lost: dict[str, list[float]] = {form: [] for form in (*answers, _DRAWN, _DRAWN_KEPT)}
    for rows in zip(*answers.values(), strict=True):
        decision = rows[0].decision
        levels = scenario.max_velocity + 1
        actions = [Action(sensor, v) for sensor in decision.prompts[PAPER].sensors for v in range(levels)]
        answered = {form: action(form, decision, one.answer, levels) for form, one in zip(answers, rows, strict=True)}
        judgement = evaluate(decision.situation, [*actions, *(one for one in answered.values() if one is not None)])
        best, drawn = judgement.lost.min(), judgement.lost[: len(actions)].mean()
        losses = iter(judgement.lost[len(actions) :].tolist())
        for form, one in answered.items():
            lost[form].append(float((drawn if one is None else next(losses)) - best))
        lost[_DRAWN].append(float(drawn - best))
        kept = np.isin([sensor for sensor, _ in actions], decision.prompts[LLM].sensors)
        lost[_DRAWN_KEPT].append(float(judgement.lost[: len(actions)][kept].mean() - best))
    return lost


def action(form: str, decision: FlownDecision, answer: TimedAnswer, levels: int) -> Action | None:
    """The sensor and velocity of an answer; None for an invalid one."""
    prompt = decision.prompts[form]
    if prompt.offer is not None:
        return prompt.offer.actions[prompt.offer.labels[answer.text]] if answer.text in prompt.offer.labels else None
    try:
        return check_answer(answer.text, prompt.sensors, levels)
    except NoDecision:
        return None


def tables(found: dict[str, Any]) -> dict[str, dict[str, dict[str, Cell]]]:
    """The tables of the report."""
    ratios = {"own": "to paper's: whole", "new": "newly read", "new_to_whole": "to its whole"}
    tokens = {
        label: {
            **{count: found["tokens"][form][count]["mean"] for count in _COUNTS},
            **{title: found["tokens"][form]["ratio"][name] for name, title in ratios.items()},
        }
        for form, label in FORMS.items()
    }
    asked = found["asked"]
    above, to_paper = "lost packets above the best", {"difference": "difference to paper", "ratio": "ratio to paper"}
    quality: dict[str, dict[str, Cell]] = {}
    for form, lost in asked["lost_packets_above_best"].items():
        quality[FORMS.get(form, form)] = {above: [lost["mean"], lost["low"], lost["high"]]}
        if form in asked:
            row = {"s": asked[form]["seconds_median"], "to the paper's": asked[form]["to_paper_seconds"]}
            quality[FORMS[form]] = row | quality[FORMS[form]]
    for pair in asked["compared"]:
        row = quality[FORMS.get(pair["scheme"], pair["scheme"])]
        row[to_paper[pair["kind"]]] = [pair["mean"], pair["low"], pair["high"]]
    return {"Tokens a decision": tokens, "The embedded LLM's answers": quality}


if __name__ == "__main__":
    run(Tokens, measure)
