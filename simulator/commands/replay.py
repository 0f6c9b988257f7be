"""``aicvds replay``: send a logged mission's requests again, to another model, prompt, k or mode."""

import os
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ValidationError
from rich.console import Console
from rich.progress import track
from tyro.conf import FlagCreatePairsOff, Positional, arg

from shared.client.calls import Exchange
from shared.client.edge_client import API_KEY, EdgeClient
from shared.client.errors import EdgeError
from shared.wire.schemas import DecideRequest, Features, FeedbackRequest, Init, MissionSpec, Mode, Outcome, Selection
from simulator.commands.options import check_deadline, check_wait, edge_from_option
from simulator.commands.running import command_main
from simulator.errors import INTERRUPTED, UsageError
from simulator.flying.edge_session import DEFAULT_TIMEOUT_S, NETWORK_SLACK_S, await_edge
from simulator.flying.job import new_mission_id
from simulator.records.decision import Decision
from simulator.records.mission_logs import read_decisions, read_requests
from simulator.records.run_folder import DECISIONS, REQUESTS, fresh_folder, naming_out, refuse_old_result
from simulator.reporting.replay_agreement import Compared, ReplaySummary, agreement, by_source, show, side

REPLAY, REPLAYED = "replay.json", "replayed.jsonl"


@dataclass(frozen=True)
class Replay:
    """Send the requests of a logged mission again, to another model, number of experiences, k or mode.

    Fly and log a mission, then start an edge with another LLM (or other settings) and replay against it:

      aicvds simulate --edge http://127.0.0.1:8000 --out runs/first

      aicvds serve --port 8001 --store none --llm-url http://localhost:11434/v1

      aicvds replay runs/first --edge http://127.0.0.1:8001 --out runs/other-model

    The same edge with another prompt, or without its LLM:

      aicvds replay runs/first --edge http://127.0.0.1:8000 --top-k 3

      aicvds replay runs/first --edge http://127.0.0.1:8000 --mode value

    No UAV flies: the states are the logged ones, whatever the new decisions. A replay therefore measures agreement,
    tokens, latency and cost, and no losses. A logged outcome is fed back only if the decision is the same; the cost of
    another sensor or velocity is unknown. After different decisions, the edge's records of visits, and with them the
    ages in its prompts, follow its own decisions and not the flight.

    Written to --out: replay.json (agreement by source; tokens, latency and cost of both missions) and replayed.jsonl
    (each decision with the logged one). Exit code: 0 complete, 1 no edge, or the edge was lost (the decisions so far
    are written), 2 bad use, 130 interrupted (written too). The key of an edge is read from AICVDS_API_KEY.
    """

    run: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of `aicvds simulate --edge` or `aicvds fly`."""
    edge: Annotated[str | None, arg(metavar="URL", help_behavior_hint="")] = None
    """The edge's address, such as http://127.0.0.1:8000. Required."""
    mode: Annotated[Mode | None, arg(metavar="MODE", help_behavior_hint="")] = None
    """The edge's mode. Default, of this option and the next ones: as logged."""
    top_k: Annotated[int | None, arg(metavar="K", help_behavior_hint="")] = None
    """Sensors that attention keeps for the prompt, 1 to 100."""
    attention: Annotated[Literal["on", "off"] | None, arg(metavar="on|off", help_behavior_hint="")] = None
    """off: every admissible sensor is in the prompt."""
    features: Annotated[Features | None, arg(metavar="paper|reach", help_behavior_hint="")] = None
    """The modules' features."""
    init: Annotated[Init | None, arg(metavar="pretrained|random", help_behavior_hint="")] = None
    """The modules' initial weights."""
    order: Annotated[Literal["score", "shuffled"] | None, arg(metavar="score|shuffled", help_behavior_hint="")] = None
    """The rows' order."""
    experiences: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Experiences in the prompt, 0 to 100."""
    selection: Annotated[Selection | None, arg(metavar="recent|failures", help_behavior_hint="")] = None
    """The selection of experiences beyond that number."""
    deadline_ms: Annotated[int | None, arg(metavar="MS", help_behavior_hint="")] = None
    """Milliseconds that the edge may take for one decision, 10 to 60000. Default: as in each request."""
    wait_s: Annotated[float, arg(metavar="S")] = 120.0
    """Seconds to wait for the edge and its LLM."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder to write to, made if missing. Default: runs/ and the new mission's ID."""
    overwrite: Annotated[bool, FlagCreatePairsOff] = False
    """Overwrite an earlier replay's result."""


_OF_SPEC = ("mode", "top_k", "attention", "features", "init")
_OF_PROMPT = ("order", "experiences", "selection")


def main(argv: list[str]) -> int:
    """Run ``aicvds replay``; returns the exit code."""
    command = shlex.join(["aicvds", "replay", *argv])
    return command_main(Replay, "aicvds replay", argv, lambda options, console: replay(options, command, console))


@dataclass(frozen=True)
class LoggedMission:
    """A logged mission: its spec, and each request with the decision flown."""

    spec: MissionSpec
    decisions: list[tuple[DecideRequest, Decision]]


def read_logged_mission(run: Path) -> LoggedMission:
    """The mission in a folder of ``aicvds simulate``; raises ``UsageError`` if it cannot be replayed."""
    if not run.is_dir():
        raise UsageError(f"{run} is no folder; name one that `aicvds simulate --edge URL` wrote")
    if not (run / REQUESTS).exists():
        raise UsageError(
            f"{run} has no {REQUESTS}: `aicvds simulate --edge URL` writes it, and a local --policy sends no request. "
            "Fly the mission again"
        )
    try:
        spec, requests = read_requests(run / REQUESTS)
        flown = {(d.step, d.uav_id): d for d in read_decisions(run / DECISIONS)}
    except OSError as error:
        raise UsageError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    pairs = [(request, (request.step, request.uav_id)) for request in requests]
    # An interrupted mission has a few requests without a flown decision.
    decisions = [(request, flown[key]) for request, key in pairs if key in flown]
    if not decisions:
        raise UsageError(f"{run} has no decision to replay")
    return LoggedMission(spec, decisions)


def replay(options: Replay, command: str, console: Console) -> int:
    """Send the requests, compare, write, print; returns the exit code.

    Raises:
        UsageError: the options or the folder are unusable.
        EdgeError: no edge is ready, or the edge refuses the changed mission.
    """
    check(options)
    edge = edge_from_option(options.edge)
    logged = read_logged_mission(options.run)
    spec = apply_options(logged.spec, options)
    assert not isinstance(spec.scenario, str), "an edge resolves the scenario's name"
    mission_id = f"{new_mission_id(spec.scenario, spec.seed)}-replay"
    out = options.out or Path("runs") / mission_id
    refuse_old_result(out, options.overwrite, REPLAY)
    longest_ms = options.deadline_ms or max(request.deadline_ms or 0 for request, _ in logged.decisions)
    timeout_s = max(DEFAULT_TIMEOUT_S, longest_ms / 1000 + NETWORK_SLACK_S)
    with EdgeClient(edge, timeout_s=timeout_s, api_key=os.environ.get(API_KEY) or None) as client:
        await_edge(client, options.wait_s, console)
        client.put_mission(mission_id, spec)
        fresh_folder(out, (REPLAY, REPLAYED))
        replayer = Replayer(client, mission_id, options.deadline_ms)
        code = _replay_all(replayer, logged, out, console)
    facts = {"run": str(options.run), "edge": edge, "mission_id": mission_id, "command": command}
    summary = summarise(logged, spec, replayer.compared, **facts)
    with naming_out(out):
        (out / REPLAY).write_text(summary.model_dump_json(indent=2) + "\n", encoding="utf-8")
    show(summary, console)
    for name in (REPLAY, REPLAYED):
        console.print(f"Wrote {out / name}", markup=False, highlight=False, soft_wrap=True)
    return code


def summarise(logged: LoggedMission, spec: MissionSpec, compared: list[Compared], **facts: str) -> ReplaySummary:
    """The summary of a replay with ``spec``."""
    return ReplaySummary(
        **facts,
        version=version("aic-vds"),
        spec=spec,
        changed=changes(logged.spec, spec),
        decisions=len(compared),
        unasked=len(logged.decisions) - len(compared),
        outcomes_fed_back=sum(c.fed_back for c in compared),
        agreement=agreement(compared),
        by_source=by_source(compared),
        logged=side([c.logged for c in compared]),
        replayed=side([c.replayed for c in compared]),
    )


class Replayer:
    """Sends logged requests to an edge; ``compared`` pairs the decisions so far with the logged ones."""

    def __init__(self, client: EdgeClient, mission_id: str, deadline_ms: int | None) -> None:
        self._client = client
        self._mission_id = mission_id
        self._deadline_ms = deadline_ms
        self._pending_outcomes: dict[int, Outcome] = {}
        self.compared: list[Compared] = []

    def replay(self, request: DecideRequest, flown: Decision) -> Compared:
        """Send one request, with the outcome of this UAV's last decision if that equalled the logged one.

        Raises:
            EdgeError: the edge gives no usable answer.
        """
        changes: dict[str, Any] = {
            "mission_id": self._mission_id,
            "outcome": self._pending_outcomes.pop(request.uav_id, None),
        }
        if self._deadline_ms is not None:
            changes["deadline_ms"] = self._deadline_ms
        exchange = self._client.decide(request.model_copy(update=changes))
        compared = Compared(logged=flown, replayed=_decision(flown, exchange))
        if compared.same:
            self._pending_outcomes[request.uav_id] = exchange.outcome(flown.cost, flown.failed)
            compared = compared.model_copy(update={"fed_back": True})
        self.compared.append(compared)
        return compared

    def finish(self) -> None:
        """Send the outcomes that no later request carried."""
        for uav in sorted(self._pending_outcomes):
            outcome = self._pending_outcomes[uav]
            self._client.feedback(FeedbackRequest(mission_id=self._mission_id, **outcome.model_dump()))
        self._pending_outcomes.clear()


def _replay_all(replayer: Replayer, logged: LoggedMission, out: Path, console: Console) -> int:
    """Replay the requests in the order flown, and write each decision at once; returns the exit code so far."""
    with naming_out(out):
        log = (out / REPLAYED).open("w", encoding="utf-8")
    try:
        with log:
            for request, flown in track(logged.decisions, description="Replaying", console=console):
                log.write(replayer.replay(request, flown).line() + "\n")
                log.flush()
            replayer.finish()
    except EdgeError as error:
        print(f"aicvds replay: after {len(replayer.compared)} decisions: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        console.print(f"interrupted after {len(replayer.compared)} decisions", highlight=False)
        return INTERRUPTED
    return 0


def _decision(flown: Decision, exchange: Exchange) -> Decision:
    from simulator.records.flight import exchange_fields

    asked = {name: getattr(flown, name) for name in ("step", "uav_id", "position")}
    answered = {name: getattr(exchange.response, name) for name in ("sensor_id", "velocity", "source", "reason")}
    return Decision(**asked, **answered, **exchange_fields(exchange))


def check(options: Replay) -> None:
    """Raises ``UsageError`` for the first option out of bounds."""
    check_wait(options.wait_s)
    check_deadline(options.deadline_ms)


def apply_options(spec: MissionSpec, options: Replay) -> MissionSpec:
    """The logged spec with the options' changes; raises ``UsageError`` for a value out of bounds."""
    fields = {name: getattr(options, name) for name in _OF_SPEC if getattr(options, name) is not None}
    prompt = {name: getattr(options, name) for name in _OF_PROMPT if getattr(options, name) is not None}
    try:
        style = spec.prompt.model_validate(spec.prompt.model_dump() | prompt)
        return MissionSpec.model_validate(dict(spec) | fields | {"prompt": style})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        option = str(first["loc"][-1]).replace("_", "-")
        raise UsageError(f"--{option} {first['input']}: {first['msg']}") from None


def changes(before: MissionSpec, after: MissionSpec) -> dict[str, tuple[Any, Any]]:
    """The fields that differ, as pairs of the values before and after."""

    def settings(spec: MissionSpec) -> Iterator[tuple[str, Any]]:
        yield from ((name, getattr(spec, name)) for name in _OF_SPEC)
        yield from ((f"prompt.{name}", getattr(spec.prompt, name)) for name in _OF_PROMPT)

    pairs = zip(settings(before), settings(after), strict=True)
    return {name: (old, new) for (name, old), (_, new) in pairs if old != new}
