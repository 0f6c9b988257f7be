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

from benchmarks.flown_prompts import GUIDED, LLM, FleetPrompt, FlownDecision, RecordingPilot, flown
from benchmarks.harness import Cell, Options, Report, in_turn, run
from lab.benchmarks.local_llm import LocalLLM, TimedAnswer
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
class DecisionQueue:
    """One server and its queue of the mission's decisions, in their order."""

    form: str
    llm: LocalLLM
    decisions: Iterator[FlownDecision]
    levels: int
    limit_s: float
    body: dict[str, Any] = field(default_factory=dict)

    def ask(self) -> TimedAnswer:
        """Request the next decision, as the edge would."""
        self.body = next(self.decisions).prompts[self.form].body(self.levels)
        return self.llm.ask(self.body, self.limit_s)

    def ask_cold(self) -> TimedAnswer:
        """Request the last decision again; the server reads the whole prompt."""
        return self.llm.ask(self.body, self.limit_s, cache_prompt=False)


Times = dict[str, list[TimedAnswer]]


def measure(args: Llm) -> Report:
    """Fly, then request decisions for one UAV and for the fleet."""
    torch.set_num_threads(1)
    scenario = scenario_named("paper")
    if args.steps is not None:
        scenario = scenario.model_copy(update={"steps": args.steps})
    pilot = flown(scenario, args.seed, args.policy)
    single, fleet = decisions(pilot, scenario, args), fleets(pilot, scenario, args)
    found = {"cores": usable_cores(), "rounds": args.rounds, "limit_s": args.limit_s, **single, "fleet": fleet}
    tables: dict[str, dict[str, dict[str, Cell]]] = {
        "Time to a decision": single["times"],
        "Ratios [95% interval]": {name: {"ratio": ratio} for name, ratio in single["ratios"].items()},
        "A fleet's step, mode guided": fleet,
    }
    return Report(found, tables)


def decisions(pilot: RecordingPilot, scenario: Scenario, args: Llm) -> dict[str, Any]:
    """One UAV's decisions in every condition: ``<form> <cold|cached> <threads> <quiet|busy>``."""
    # From this decision on the block of experiences is full.
    flown_decisions = pilot.decisions[len(pilot.decisions) // 3 :]
    if len(flown_decisions) < 2 * args.rounds + 1:
        raise SystemExit(f"--rounds: the mission has decisions for {(len(flown_decisions) - 1) // 2} at most")
    context, levels = Settings().llm_context, scenario.max_velocity + 1
    first: Times = {}
    variants: dict[str, Callable[[int], TimedAnswer]] = {}
    with ExitStack() as stack:
        queues = {
            (form, threads): DecisionQueue(
                form, stack.enter_context(LocalLLM(threads, context)), iter(flown_decisions), levels, args.limit_s
            )
            for threads in args.threads
            for form in (GUIDED, LLM)
        }
        for queue in queues.values():
            # The cache of the server is empty.
            first.setdefault(f"{queue.form} first", []).append(queue.ask())
        for load in (QUIET, BUSY):
            for (form, threads), queue in queues.items():
                variants[f"{form} cached {threads} {load}"] = with_load(queue.ask, load)
                if load == QUIET:
                    variants[f"{form} cold {threads} {load}"] = with_load(queue.ask_cold, load)
        times = first | in_turn(variants, args.rounds)
        load_s = statistics.median(queue.llm.load_s for queue in queues.values())
    return {"load_s_median": load_s, "times": summed(times), "ratios": ratios(times, args.threads)}


def with_load(ask: Callable[[], TimedAnswer], load: str) -> Callable[[int], TimedAnswer]:
    """The request as a variant for :func:`in_turn`, sent while the neighbours run."""

    def request(_: int) -> TimedAnswer:
        with neighbours(load):
            return ask()

    return request


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
    """Median times, and means of the newly read and written tokens."""
    return {
        name: {
            "seconds_median": statistics.median(one.seconds for one in answers),
            "first_token_s_median": statistics.median(one.first_s for one in answers),
            "cpu_s_median": statistics.median(one.cpu_s for one in answers),
            "new_mean": statistics.fmean(one.new for one in answers),
            "written_mean": statistics.fmean(one.written for one in answers),
            "late": sum(one.late for one in answers),
        }
        for name, answers in times.items()
    }


def ratios(times: Times, threads: Sequence[int]) -> dict[str, list[float]]:
    """Ratios of medians between conditions of the same rounds."""

    def of(ours: str, theirs: str) -> list[float]:
        return ratio_of_medians([one.seconds for one in times[ours]], [one.seconds for one in times[theirs]])

    found = {}
    for n in threads:
        for form in (GUIDED, LLM):
            found[f"{form}, {n} threads: cached / cold"] = of(f"{form} cached {n} quiet", f"{form} cold {n} quiet")
            found[f"{form}, {n} threads: busy / quiet"] = of(f"{form} cached {n} busy", f"{form} cached {n} quiet")
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


def fleets(pilot: RecordingPilot, scenario: Scenario, args: Llm) -> dict[str, Any]:
    """The time to the last decision of a step, in mode ``guided`` with the default number of threads.

    Each way to request the decisions has a server of its own, with the previous step in its cache.
    """
    steps = whole_steps(pilot, scenario)[-args.rounds - 1 :]
    threads, uavs, context = Settings().embedded_threads, scenario.uavs, Settings().llm_context
    with ExitStack() as stack, ThreadPoolExecutor(uavs) as pool:

        def step(name: str) -> Callable[[int], tuple[float, float, int]]:
            llm = stack.enter_context(LocalLLM(threads, context, slots=uavs if name == SLOTS else 1))

            def request(number: int) -> tuple[float, float, int]:
                began, cpu_began = time.perf_counter(), time.process_time()
                answers = ask_fleet(name, llm, *steps[number + 1], args.limit_s, pool)
                took, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
                return took, cpu_s, sum(one.new for one in answers)

            return request

        # The first step has an empty cache.
        found = in_turn({name: step(name) for name in (ROW, CALL, QUEUE, SLOTS)}, len(steps) - 1, warm_up=1)
    seconds = {name: [took for took, _, _ in measured] for name, measured in found.items()}
    return {
        name: {
            "seconds_median": statistics.median(seconds[name]),
            "cpu_s_median": statistics.median(cpu_s for _, cpu_s, _ in measured),
            "new_mean": statistics.fmean(new for _, _, new in measured),
            "to_one_after_the_other": ratio_of_medians(seconds[name], seconds[ROW]),
        }
        for name, measured in found.items()
    }


def ask_fleet(
    name: str,
    llm: LocalLLM,
    bodies: Sequence[dict[str, Any]],
    fleet_prompt: FleetPrompt,
    limit_s: float,
    pool: ThreadPoolExecutor,
) -> list[TimedAnswer]:
    """Request one step's decisions in one of the four ways."""
    if name == CALL:
        return [llm.ask(fleet_prompt.body(), limit_s)]
    if name == ROW:
        return [llm.ask(body, limit_s) for body in bodies]
    slots = range(len(bodies)) if name == SLOTS else [0] * len(bodies)
    waiting = [pool.submit(llm.ask, body, limit_s, id_slot=slot) for body, slot in zip(bodies, slots, strict=True)]
    return [one.result() for one in waiting]


def whole_steps(pilot: RecordingPilot, scenario: Scenario) -> list[tuple[list[dict[str, Any]], FleetPrompt]]:
    """The steps with a request for every UAV: these requests, and the one about all UAVs."""
    levels = scenario.max_velocity + 1
    found = []
    for fleet_prompt in pilot.fleet_prompts:
        bodies = [one.prompts[GUIDED].body(levels) for one in pilot.decisions if one.step == fleet_prompt.step]
        if len(bodies) == scenario.uavs:
            found.append((bodies, fleet_prompt))
    return found


if __name__ == "__main__":
    run(Llm, measure)
