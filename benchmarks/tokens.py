"""Tokens of a decision in the paper's template with and without attention, and their cost in time and quality.

    python -m benchmarks.tokens
    python -m benchmarks.tokens --seeds 30 --asked 3    # more decisions for the LLM: narrower intervals

It flies missions by a planner and makes the prompts of every decision in several forms: those of the edge's modes, and
the paper's with every sensor that a UAV has heard, free and charged. It counts whole prompts in tiktoken's o200k_base
and in the embedded model's own tokens, and the newly read tokens of a server that has the prompt before in its cache.
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

from benchmarks.flown_prompts import CONTEXT, GUIDED, LLM, PAPER, WAYS, Asked, flown
from benchmarks.harness import Cell, Goal, Options, Report, run
from lab.benchmarks.local_llm import Answered, LocalLLM
from lab.experiments.intervals import interval, paired, ratio_of_medians
from service.config.settings import Settings
from service.deciding.rollout_evaluator import evaluate
from service.llm.answers import NoDecision, check_answer
from service.prompting.token_accounting import TokenCounter
from shared.world.scenario import Scenario, scenario_named
from shared.world.step_rule import Action

GOAL_PROMPT, GOAL_NEW = 0.5, 0.15
# The forms with judged answers: an answer is a sensor and a velocity, or a letter for both.
JUDGED = (GUIDED, LLM, PAPER)
# The comparisons of the answers: uniform draws among all sensors of a prompt, and among those that attention keeps.
_DRAWN, _DRAWN_KEPT = "drawn", "drawn_among_kept"
_COUNTS = ("o200k", "own", "new")
# By o200k_base: the whole prompt and its blocks, as the edge's token accounting calls them.
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
    """Fly, count, ask."""
    scenario = scenario_named(args.scenario)
    if args.steps is not None:
        scenario = scenario.model_copy(update={"steps": args.steps})
    seeds = range(args.first, args.first + args.seeds)
    flights = [flown(scenario, seed, args.policy).asked for seed in track(seeds, "Flying")]
    with LocalLLM(args.threads, CONTEXT) as llm:
        tokens, name = token_figures(counted(flights, llm)), llm.name
    found: dict[str, Any] = {
        "options": asdict(args),
        "model": name,
        "decisions": [len(flight) for flight in flights],
        "tokens": tokens,
        "state_tokens_by_step": by_step(flights),
        "asked": asked_figures(put(flights, scenario, args), scenario),
    }
    ratio = tokens[GUIDED]["ratio"]
    goals = [
        Goal(f"{WAYS[GUIDED]}: tokens to the paper's", ratio["own"], most=GOAL_PROMPT),
        Goal(f"{WAYS[GUIDED]}: newly read to the paper's whole", ratio["new_to_whole"], most=GOAL_NEW),
    ]
    return Report(found, tables(found), goals)


def counted(flights: Sequence[Sequence[Asked]], llm: LocalLLM) -> dict[str, dict[str, list[float]]]:
    """By form and count one mean for each mission: tokens by o200k_base, by the model, and not in the prompt before."""
    counter = TokenCounter(Settings().cache_dir)
    means: dict[str, dict[str, list[float]]] = {way: {count: [] for count in (*_COUNTS, *_BLOCKS)} for way in WAYS}
    for flight in track(flights, "Counting"):
        for way in WAYS:
            prompts = [asked.ways[way].prompt for asked in flight]
            own = [llm.tokens(prompt) for prompt in prompts]
            new = [anew(now, before) for now, before in zip(own, [[], *own], strict=False)]
            accounts = [counter.account(prompt) for prompt in prompts]
            for count, name in _BLOCKS.items():
                means[way][count].append(statistics.fmean(getattr(account, name) for account in accounts))
            means[way]["own"].append(statistics.fmean(map(len, own)))
            means[way]["new"].append(statistics.fmean(new))
    return means


def by_step(flights: Sequence[Sequence[Asked]]) -> dict[str, dict[int, list[float]]]:
    """Tokens of the state block by o200k_base: mean and standard deviation by step, and ``all`` without any mask."""
    counter = TokenCounter(Settings().cache_dir)
    found: dict[str, dict[int, list[float]]] = {LLM: {}, PAPER: {}, "all": {}}
    every = [asked for flight in flights for asked in flight]
    for step in sorted({asked.step for asked in every}):
        prompts = {way: [asked.ways[way].prompt for asked in every if asked.step == step] for way in (LLM, PAPER)}
        counts = {way: [counter.count(prompt.state) for prompt in of_way] for way, of_way in prompts.items()}
        counts["all"] = [counter.account(prompt).state_uncompressed for prompt in prompts[PAPER]]
        for way, own in counts.items():
            found[way][step] = [statistics.fmean(own), statistics.pstdev(own)]
    return found


def anew(now: Sequence[int], before: Sequence[int]) -> int:
    """Tokens that a server reads newly, with the prompt before in its cache; always at least the last one."""
    same = next((i for i, (a, b) in enumerate(zip(now, before, strict=False)) if a != b), min(len(now), len(before)))
    return len(now) - min(same, len(now) - 1)


def token_figures(counts: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """Means and ratios to the paper's, by form; ``new_to_whole`` is to the paper's without any prefix cache."""
    theirs = counts[PAPER]
    found: dict[str, Any] = {}
    for way, ours in counts.items():
        found[way] = {count: interval(values).model_dump(exclude={"values"}) for count, values in ours.items()}
        found[way]["ratio"] = {
            **{count: _ratio(ours[count], theirs[count]) for count in _COUNTS},
            "new_to_whole": _ratio(ours["new"], theirs["own"]),
        }
    return found


def _ratio(ours: Sequence[float], theirs: Sequence[float]) -> list[float]:
    of_means = next(pair for pair in paired("ours", "theirs", "tokens", ours, theirs) if pair.kind == "ratio")
    return [of_means.mean, of_means.low, of_means.high]


@dataclass(frozen=True)
class Told:
    """One answer to one form of a decision; ``reckoned``: the expected number of newly read tokens.

    It is None for the first answer of each mission, when the cache has another mission's prompt.
    """

    asked: Asked
    answered: Answered
    reckoned: int | None


def put(flights: Sequence[Sequence[Asked]], scenario: Scenario, args: Tokens) -> dict[str, list[Told]]:
    """Ask the embedded LLM for decisions in each form of ``JUDGED``, side by side, each with a server of its own."""
    middles = [(i > 0, asked) for flight in flights for i, asked in enumerate(middle(flight, args.asked + 1))]
    answers: dict[str, list[Told]] = {way: [] for way in JUDGED}
    before: dict[str, list[int]] = {}
    with ExitStack() as stack:
        models = {way: stack.enter_context(LocalLLM(args.threads, CONTEXT)) for way in JUDGED}
        for warm, asked in track(middles, "Asking"):
            for way, llm in models.items():
                now = llm.tokens(asked.ways[way].prompt)
                answered = llm.ask(asked.ways[way].body(scenario.max_velocity + 1))
                answers[way].append(Told(asked, answered, anew(now, before[way]) if warm else None))
                before[way] = now
    return answers


def middle(flight: Sequence[Asked], count: int) -> Sequence[Asked]:
    """Consecutive decisions from the middle on, with 30 experiences; fewer if the mission is shorter."""
    return flight[len(flight) // 2 :][:count]


def asked_figures(answers: dict[str, list[Told]], scenario: Scenario) -> dict[str, Any]:
    """The measurements of the LLM's decisions: time, newly read tokens, expected losses."""
    lost = judged(answers, scenario)
    warm = {way: [one for one in told if one.reckoned is not None] for way, told in answers.items()}
    paper_s = [one.answered.seconds for one in warm[PAPER]]
    found: dict[str, Any] = {"decisions": len(answers[PAPER]), "lost_packets_above_best": {}, "compared": []}
    for way, told in warm.items():
        found[way] = {
            "seconds_median": statistics.median(one.answered.seconds for one in told),
            "to_paper_seconds": ratio_of_medians([one.answered.seconds for one in told], paper_s),
            "new_mean": statistics.fmean(one.answered.new for one in told),
            "new_as_reckoned": sum(one.answered.new == one.reckoned for one in told) / len(told),
            "late": sum(one.answered.late for one in told),
        }
    for way, values in lost.items():
        found["lost_packets_above_best"][way] = interval(values).model_dump()
        if way != PAPER:
            found["compared"] += [pair.model_dump() for pair in paired(way, PAPER, "lost", values, lost[PAPER])]
    return found


def judged(answers: dict[str, list[Told]], scenario: Scenario) -> dict[str, list[float]]:
    """Packets that the fleet is expected to lose after each answer above the best one, and after uniform draws.

    The candidates are all sensors of the prompt at all velocities. An invalid answer loses as much as a draw.
    """
    lost: dict[str, list[float]] = {way: [] for way in (*answers, _DRAWN, _DRAWN_KEPT)}
    for rows in zip(*answers.values(), strict=True):
        asked = rows[0].asked
        levels = scenario.max_velocity + 1
        actions = [Action(sensor, v) for sensor in asked.ways[PAPER].sensors for v in range(levels)]
        said = {way: action(way, asked, one.answered, levels) for way, one in zip(answers, rows, strict=True)}
        judgement = evaluate(asked.situation, [*actions, *(one for one in said.values() if one is not None)])
        best, drawn = judgement.lost.min(), judgement.lost[: len(actions)].mean()
        told = iter(judgement.lost[len(actions) :].tolist())
        for way, one in said.items():
            lost[way].append(float((drawn if one is None else next(told)) - best))
        lost[_DRAWN].append(float(drawn - best))
        kept = np.isin([sensor for sensor, _ in actions], asked.ways[LLM].sensors)
        lost[_DRAWN_KEPT].append(float(judgement.lost[: len(actions)][kept].mean() - best))
    return lost


def action(way: str, asked: Asked, answered: Answered, levels: int) -> Action | None:
    """The sensor and velocity of an answer."""
    put = asked.ways[way]
    if put.offer is not None:
        return put.offer.actions[put.offer.labels[answered.text]] if answered.text in put.offer.labels else None
    try:
        return check_answer(answered.text, put.sensors, levels)
    except NoDecision:
        return None


def tables(found: dict[str, Any]) -> dict[str, dict[str, dict[str, Cell]]]:
    """For the reader."""
    ratios = {"own": "to paper's: whole", "new": "newly read", "new_to_whole": "to its whole"}
    tokens = {
        label: {
            **{count: found["tokens"][way][count]["mean"] for count in _COUNTS},
            **{title: found["tokens"][way]["ratio"][name] for name, title in ratios.items()},
        }
        for way, label in WAYS.items()
    }
    told = found["asked"]
    above, to_paper = "lost packets above the best", {"difference": "difference to paper", "ratio": "ratio to paper"}
    quality: dict[str, dict[str, Cell]] = {}
    for way, lost in told["lost_packets_above_best"].items():
        quality[WAYS.get(way, way)] = {above: [lost["mean"], lost["low"], lost["high"]]}
        if way in told:
            row = {"s": told[way]["seconds_median"], "to the paper's": told[way]["to_paper_seconds"]}
            quality[WAYS[way]] = row | quality[WAYS[way]]
    for pair in told["compared"]:
        row = quality[WAYS.get(pair["scheme"], pair["scheme"])]
        row[to_paper[pair["kind"]]] = [pair["mean"], pair["low"], pair["high"]]
    return {"Tokens a decision": tokens, "The embedded LLM's answers": quality}


if __name__ == "__main__":
    run(Tokens, measure)
