"""Tokens of a decision beside the paper's own template, their cost in time and quality, and a compressor's.

    python benchmarks/tokens.py
    python benchmarks/tokens.py --seeds 30 --asked 3    # more decisions for the LLM: narrower intervals

It flies missions by a planner and makes the prompts of every decision in several forms: those of the edge's modes, and
the paper's, with all sensors in words and 30 experiences (`paper_template.py` says which parts of it are known). It
counts whole prompts in tiktoken's o200k_base and in the embedded model's own tokens, and the newly read tokens of a
server that has the prompt before in its cache. The embedded model answers some decisions from the middle of each
mission: the benchmark measures time, the server's own account of its cache, and the answers' quality by the edge's
rollout evaluator. Last, it measures whether a compressor of LLMLingua-2's size pays. Intervals are 95% bootstrap
intervals over missions (tokens), decisions (quality) or pairs (times).
"""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from compressors import KEPT, LARGE, SMALL, TINY, WINDOW, Compressor, Size, attention_s
from flown_prompts import CONTEXT, GUIDED, LLM, LLM_ALL, PAPER, WAYS, Asked, flown
from local_llm import Answered, LocalLLM
from paper_template import STATED_STATE_TOKENS
from ratios import ratio_of_medians, shown
from rich.console import Console
from rich.progress import track
from rich.table import Table

from lab.experiments.intervals import interval, paired
from service.config.settings import Settings
from service.deciding.rollout_evaluator import evaluate
from service.llm.answers import NoDecision, check_answer
from service.prompting.token_accounting import TokenCounter
from shared.world.actions import Action
from shared.world.scenario import Scenario, scenario_named

GOAL_PROMPT, GOAL_NEW = 0.5, 0.15
# The forms with judged answers: an answer is a sensor and a velocity, or a letter for both.
JUDGED = (GUIDED, LLM, PAPER)
# The comparisons of the answers: uniform draws among all sensors of a prompt, and among those that attention keeps.
_DRAWN, _DRAWN_KEPT = "drawn", "drawn_among_kept"
# Prefill speeds, tokens a second, for which the benchmark computes whether compression pays.
SPEEDS = (50, 200, 1_000, 10_000)
_COUNTS = ("o200k", "own", "new")
# By o200k_base: the whole prompt and its blocks, as the edge's token accounting calls them.
_BLOCKS = {"o200k": "prompt", "o200k_static": "static", "o200k_experiences": "experiences", "o200k_state": "state"}


@dataclass(frozen=True)
class Tokens:
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
    """Threads of the embedded LLM and of the compressor."""
    encoders: Literal["real", "tiny"] = "real"
    """Sizes of the compressors; `tiny` only shows that the benchmark runs."""
    repeats: int = 3
    """Repetitions of a compressor's window."""
    out: Path = Path("runs/tokens.json")
    """Where to write the figures."""


def main(args: Tokens) -> int:
    """Fly, count, ask, compress; print and write."""
    torch.set_num_threads(args.threads)
    console, scenario = Console(), scenario_named(args.scenario)
    if args.steps is not None:
        scenario = scenario.model_copy(update={"steps": args.steps})
    seeds = range(args.first, args.first + args.seeds)
    flights = [flown(scenario, seed, args.policy).asked for seed in track(seeds, "Flying", console=console)]
    with LocalLLM(args.threads, CONTEXT) as llm:
        counts = counted(flights, llm, console)
        name = llm.name
    answers = put(flights, scenario, args, console)
    found: dict[str, Any] = {
        "command": sys.argv,
        "options": {**asdict(args), "out": str(args.out)},
        "model": name,
        "decisions": [len(flight) for flight in flights],
        "tokens": token_figures(counts),
        "state_tokens_stated_by_the_paper": STATED_STATE_TOKENS,
        "asked": asked_figures(answers, scenario),
        "goal": {"prompt": GOAL_PROMPT, "new": GOAL_NEW},
    }
    window, read_s = compressing(flights[-1][-1], scenario, args, console)
    found["compression"] = compression_figures(found["tokens"], window, read_s, attention_s(scenario, 200))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")
    tell(found, console)
    console.print(f"Wrote {args.out}")
    return 0


def counted(flights: Sequence[Sequence[Asked]], llm: LocalLLM, console: Console) -> dict[str, dict[str, list[float]]]:
    """By form and count one mean for each mission: tokens by o200k_base, by the model, and not in the prompt before."""
    counter = TokenCounter(Settings().cache_dir)
    means: dict[str, dict[str, list[float]]] = {way: {count: [] for count in (*_COUNTS, *_BLOCKS)} for way in WAYS}
    for flight in track(flights, "Counting", console=console):
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


def put(
    flights: Sequence[Sequence[Asked]], scenario: Scenario, args: Tokens, console: Console
) -> dict[str, list[Told]]:
    """Ask the embedded LLM for decisions in each form of ``JUDGED``, side by side, each with a server of its own."""
    middles = [(i > 0, asked) for flight in flights for i, asked in enumerate(middle(flight, args.asked + 1))]
    answers: dict[str, list[Told]] = {way: [] for way in JUDGED}
    before: dict[str, list[int]] = {}
    with ExitStack() as stack:
        models = {way: stack.enter_context(LocalLLM(args.threads, CONTEXT)) for way in JUDGED}
        for warm, asked in track(middles, "Asking", console=console):
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


def compressing(
    last: Asked, scenario: Scenario, args: Tokens, console: Console
) -> tuple[dict[str, list[float]], list[float]]:
    """Seconds of a window by compressor, and the embedded LLM's seconds to read a token, measured side by side."""
    sizes: Sequence[Size] = (SMALL, LARGE) if args.encoders == "real" else (TINY,)
    encoders = {size.label: Compressor(size) for size in sizes}
    window: dict[str, list[float]] = {label: [] for label in encoders}
    read_s: list[float] = []
    body = last.ways[PAPER].body(scenario.max_velocity + 1)
    # About one window: the static block, and little more.
    body["messages"] = [body["messages"][0], {"role": "user", "content": "Current state: none"}]
    with LocalLLM(args.threads, CONTEXT) as llm:
        for _ in track(range(args.repeats), "Compressing", console=console):
            for label, encoder in encoders.items():
                window[label].append(encoder.window_s(WINDOW))
            answered = llm.ask(body, cache_prompt=False, max_tokens=1)
            read_s.append(answered.seconds / max(1, answered.new))
    return window, read_s


def compression_figures(
    tokens: dict[str, Any], window: dict[str, list[float]], read_s: Sequence[float], attention: Sequence[float]
) -> dict[str, Any]:
    """Seconds spent to seconds saved, and the prefill speed below which compression pays.

    An encoder's time is measured on one window; a prompt's time is proportional to it.
    """
    prompt, speed = tokens[PAPER]["own"]["mean"], 1 / statistics.median(read_s)
    reckoned_s = {f"{way}, cached": tokens[way]["new"]["mean"] / speed for way in (GUIDED, LLM, PAPER)}
    reckoned_s |= {f"{PAPER}, whole": prompt / speed}
    compressors = {}
    for label, took in window.items():
        median = statistics.median(took)
        reckoned_s[f"{PAPER}, halved by {label}"] = median * prompt / WINDOW + KEPT * prompt / speed
        compressors[label] = {
            "window_s_median": median,
            "spent_to_saved_embedded": ratio_of_medians(took, [s * WINDOW * (1 - KEPT) for s in read_s]),
            "spent_to_saved_at_speed_reckoned": {str(at): median / WINDOW * at / (1 - KEPT) for at in SPEEDS},
            "pays_below_tokens_per_s": WINDOW * (1 - KEPT) / median,
        }
    saved = tokens[LLM_ALL]["new"]["mean"] - tokens[LLM]["new"]["mean"]
    return {
        "kept": KEPT,
        "embedded_prefill_tokens_per_s": speed,
        "seconds_to_read_reckoned": reckoned_s,
        "compressors": compressors,
        "attention": {
            "ms_median": statistics.median(attention) * 1e3,
            "ms_p99": float(np.quantile(attention, 0.99)) * 1e3,
            "tokens_saved": saved,
            "pays_below_tokens_per_s": saved / statistics.median(attention),
        },
    }


def tell(found: dict[str, Any], console: Console) -> None:
    """Print the figures."""
    table = Table(
        "", "o200k", "own", "newly read", "to paper's: whole", "newly read", "to its whole", title="Tokens a decision"
    )
    for way, label in WAYS.items():
        row = found["tokens"][way]
        means = [f"{row[count]['mean']:.0f}" for count in _COUNTS]
        ratios = [shown(row["ratio"][name]) for name in ("own", "new", "new_to_whole")]
        table.add_row(label, *means, *ratios)
    console.print(table)
    told = found["asked"]
    for way in JUDGED:
        one, lost = told[way], told["lost_packets_above_best"][way]
        console.print(
            f"{WAYS[way]}: {one['seconds_median']:.2f} s, {shown(one['to_paper_seconds'])} times the paper's; "
            f"expected to lose {lost['mean']:.2f} [{lost['low']:.2f}, {lost['high']:.2f}] packets above the best",
            highlight=False,
        )
    for name in (_DRAWN, _DRAWN_KEPT):
        drawn = told["lost_packets_above_best"][name]
        console.print(f"{name}: {drawn['mean']:.2f} [{drawn['low']:.2f}, {drawn['high']:.2f}]", highlight=False)
    for pair in told["compared"]:
        console.print(f"{pair['scheme']} - paper, {pair['kind']}: {shown([pair['mean'], pair['low'], pair['high']])}")
    for label, one in found["compression"]["compressors"].items():
        console.print(
            f"{label}: {shown(one['spent_to_saved_embedded'])} times what halving saves the embedded LLM; "
            f"pays below {one['pays_below_tokens_per_s']:.0f} tokens/s",
            highlight=False,
        )
    for label, seconds in found["compression"]["seconds_to_read_reckoned"].items():
        console.print(f"reading {label}: {seconds:.2f} s, computed", highlight=False)
    attention = found["compression"]["attention"]
    console.print(
        f"attention: {attention['ms_median']:.3f} ms for {attention['tokens_saved']:.1f} tokens; pays below "
        f"{attention['pays_below_tokens_per_s']:.0f} tokens/s (embedded: "
        f"{found['compression']['embedded_prefill_tokens_per_s']:.0f})",
        highlight=False,
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Tokens, description=__doc__)))
