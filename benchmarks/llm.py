"""The embedded LLM's time for a decision: by prefix cache, threads, busy neighbours, and concurrent UAVs.

    python -m benchmarks.llm
    python -m benchmarks.llm --rounds 15    # narrower intervals

The prompts are a mission's own, in their order, in modes `guided` (scoring: one forward pass, whose answer is the
probabilities of single-token labels) and `llm` (generating: a sensor and a velocity under a grammar).
In every round each server gets one request in each condition: nothing or a busy process on every other core, llama.cpp
with one thread and with two. `cold` reads the whole prompt, `cached` only the tokens new since the decision before,
`first` is the first request to a newly started server. Then the fleet's decisions of one step are requested in four
ways. Times are from request to answer; ratios are of medians, with 95% bootstrap intervals over rounds. The processor's
seconds are this process's, and other work on the machine changes them least.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import torch

from benchmarks.flown_prompts import GUIDED, LLM, Asked, Scribe, Together, flown
from benchmarks.harness import Cell, Options, Report, in_turn, run
from lab.benchmarks.local_llm import Answered, LocalLLM
from lab.experiments.intervals import ratio_of_medians
from service.config.settings import Settings
from shared.kit.cores import usable_cores
from shared.world.scenario import Scenario, scenario_named

_NEIGHBOUR = "while True: pass"
QUIET, BUSY = "quiet", "busy"
ROW, CALL, QUEUE, SLOTS = "one after the other", "one call about all", "at once, one slot", "at once, a slot each"


@dataclass(frozen=True)
class Llm(Options):
    """Measure the embedded LLM's time for an answer."""

    rounds: int = 5
    """Decisions in each condition, and steps of the fleet."""
    threads: tuple[int, ...] = (1, 2)
    """Threads of llama.cpp."""
    seed: int = 0
    """Scenario of the mission that gives the prompts."""
    steps: int | None = None
    """Steps of that mission; by default the scenario's."""
    policy: Literal["mpc", "eof"] = "mpc"
    """Policy of that mission: the planner, or the rule that is faster to compute."""
    limit_s: float = 20.0
    """The longest wait for an answer in seconds; a later answer counts as this long."""


@dataclass
class Line:
    """One server, and the mission's decisions for it, each once, in their order."""

    way: str
    llm: LocalLLM
    decisions: Iterator[Asked]
    levels: int
    limit_s: float
    body: dict[str, Any] = field(default_factory=dict)

    def ask(self) -> Answered:
        """The next decision, as the edge would ask."""
        self.body = next(self.decisions).ways[self.way].body(self.levels)
        return self.llm.ask(self.body, self.limit_s)

    def ask_cold(self) -> Answered:
        """Ask for the last decision again; the server reads the whole prompt."""
        return self.llm.ask(self.body, self.limit_s, cache_prompt=False)


Times = dict[str, list[Answered]]


def measure(args: Llm) -> Report:
    """Fly, then ask for one UAV and for the fleet."""
    torch.set_num_threads(1)
    scenario = scenario_named("paper")
    if args.steps is not None:
        scenario = scenario.model_copy(update={"steps": args.steps})
    scribe = flown(scenario, args.seed, args.policy)
    alone, fleet = decisions(scribe, scenario, args), fleets(scribe, scenario, args)
    found = {"cores": usable_cores(), "rounds": args.rounds, "limit_s": args.limit_s, **alone, "fleet": fleet}
    tables: dict[str, dict[str, dict[str, Cell]]] = {
        "Time to a decision": alone["times"],
        "Ratios [95% interval]": {name: {"ratio": ratio} for name, ratio in alone["ratios"].items()},
        "A fleet's step, mode guided": fleet,
    }
    return Report(found, tables)


def decisions(scribe: Scribe, scenario: Scenario, args: Llm) -> dict[str, Any]:
    """One UAV's decisions in every condition: ``<way> <cold|cached> <threads> <quiet|busy>``."""
    # From this decision on the block of experiences is full.
    asked = scribe.asked[len(scribe.asked) // 3 :]
    if len(asked) < 2 * args.rounds + 1:
        raise SystemExit(f"--rounds: the mission has decisions for {(len(asked) - 1) // 2} at most")
    context, levels = Settings().llm_context, scenario.max_velocity + 1
    first: Times = {}
    variants: dict[str, Callable[[int], Answered]] = {}
    with ExitStack() as stack:
        lines = {
            (way, threads): Line(
                way, stack.enter_context(LocalLLM(threads, context)), iter(asked), levels, args.limit_s
            )
            for threads in args.threads
            for way in (GUIDED, LLM)
        }
        for line in lines.values():
            # The first request to a server with an empty cache.
            first.setdefault(f"{line.way} first", []).append(line.ask())
        for load in (QUIET, BUSY):
            for (way, threads), line in lines.items():
                variants[f"{way} cached {threads} {load}"] = asking(line.ask, load)
                if load == QUIET:
                    variants[f"{way} cold {threads} {load}"] = asking(line.ask_cold, load)
        times = first | in_turn(variants, args.rounds)
        load_s = statistics.median(line.llm.load_s for line in lines.values())
    return {"load_s_median": load_s, "times": summed(times), "ratios": ratios(times, args.threads)}


def asking(ask: Callable[[], Answered], load: str) -> Callable[[int], Answered]:
    """A request in a round, with such neighbours."""

    def asked(_: int) -> Answered:
        with neighbours(load):
            return ask()

    return asked


@contextmanager
def neighbours(load: str) -> Iterator[None]:
    """Let a process spin on every core but one for the duration of the context; none for ``quiet``."""
    command = [sys.executable, "-c", _NEIGHBOUR]
    spinning = [subprocess.Popen(command) for _ in range(max(1, usable_cores() - 1) if load == BUSY else 0)]
    try:
        if spinning:
            time.sleep(0.2)
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def summed(times: Times) -> dict[str, dict[str, float]]:
    """Medians, and the newly read tokens."""
    return {
        name: {
            "seconds_median": statistics.median(one.seconds for one in told),
            "first_token_s_median": statistics.median(one.first_s for one in told),
            "cpu_s_median": statistics.median(one.cpu_s for one in told),
            "new_mean": statistics.fmean(one.new for one in told),
            "written_mean": statistics.fmean(one.written for one in told),
            "late": sum(one.late for one in told),
        }
        for name, told in times.items()
    }


def ratios(times: Times, threads: Sequence[int]) -> dict[str, list[float]]:
    """Ratios of the conditions measured side by side."""

    def of(ours: str, theirs: str) -> list[float]:
        return ratio_of_medians([one.seconds for one in times[ours]], [one.seconds for one in times[theirs]])

    found = {}
    for n in threads:
        for way in (GUIDED, LLM):
            found[f"{way}, {n} threads: cached / cold"] = of(f"{way} cached {n} quiet", f"{way} cold {n} quiet")
            found[f"{way}, {n} threads: busy / quiet"] = of(f"{way} cached {n} busy", f"{way} cached {n} quiet")
        found[f"{n} threads: scoring / generating"] = of(f"{GUIDED} cached {n} quiet", f"{LLM} cached {n} quiet")
        generated = times[f"{LLM} cached {n} quiet"]
        found[f"{n} threads: first token / all, generating"] = ratio_of_medians(
            [one.first_s for one in generated], [one.seconds for one in generated]
        )
    fewest, *more = threads
    for n in more:
        for kind in (f"cached {QUIET}", f"cached {BUSY}", f"cold {QUIET}"):
            read, load = kind.split()
            named = f"scoring, {kind}: {n} threads / {fewest}"
            found[named] = of(f"{GUIDED} {read} {n} {load}", f"{GUIDED} {read} {fewest} {load}")
    return found


def fleets(scribe: Scribe, scenario: Scenario, args: Llm) -> dict[str, Any]:
    """The decisions of all UAVs of a step, in mode ``guided``, by the default number of threads: seconds to the last.

    Each way has a server of its own, so that each has the step before in its cache.
    """
    steps = whole_steps(scribe, scenario)[-args.rounds - 1 :]
    threads, uavs, context = Settings().embedded_threads, scenario.uavs, Settings().llm_context
    with ExitStack() as stack, ThreadPoolExecutor(uavs) as pool:

        def step(name: str) -> Callable[[int], tuple[float, float, int]]:
            llm = stack.enter_context(LocalLLM(threads, context, slots=uavs if name == SLOTS else 1))

            def asked(number: int) -> tuple[float, float, int]:
                began, cpu_began = time.perf_counter(), time.process_time()
                answers = ask_fleet(name, llm, *steps[number + 1], args.limit_s, pool)
                took, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
                return took, cpu_s, sum(one.new for one in answers)

            return asked

        # The first step has an empty cache.
        found = in_turn({name: step(name) for name in (ROW, CALL, QUEUE, SLOTS)}, len(steps) - 1, warm_up=1)
    seconds = {name: [took for took, _, _ in told] for name, told in found.items()}
    return {
        name: {
            "seconds_median": statistics.median(seconds[name]),
            "cpu_s_median": statistics.median(cpu_s for _, cpu_s, _ in told),
            "new_mean": statistics.fmean(new for _, _, new in told),
            "to_one_after_the_other": ratio_of_medians(seconds[name], seconds[ROW]),
        }
        for name, told in found.items()
    }


def ask_fleet(
    name: str,
    llm: LocalLLM,
    bodies: Sequence[dict[str, Any]],
    together: Together,
    limit_s: float,
    pool: ThreadPoolExecutor,
) -> list[Answered]:
    """Ask for one step's decisions in one of the four ways."""
    if name == CALL:
        return [llm.ask(together.body(), limit_s)]
    if name == ROW:
        return [llm.ask(body, limit_s) for body in bodies]
    slots = range(len(bodies)) if name == SLOTS else [0] * len(bodies)
    waiting = [pool.submit(llm.ask, body, limit_s, id_slot=slot) for body, slot in zip(bodies, slots, strict=True)]
    return [one.result() for one in waiting]


def whole_steps(scribe: Scribe, scenario: Scenario) -> list[tuple[list[dict[str, Any]], Together]]:
    """The steps in which every UAV asks: each one's request, and the one about all."""
    levels = scenario.max_velocity + 1
    found = []
    for together in scribe.together:
        bodies = [asked.ways[GUIDED].body(levels) for asked in scribe.asked if asked.step == together.step]
        if len(bodies) == scenario.uavs:
            found.append((bodies, together))
    return found


if __name__ == "__main__":
    run(Llm, measure)
