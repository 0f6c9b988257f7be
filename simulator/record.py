"""What a mission leaves behind: one line a decision in ``decisions.jsonl``, one ``summary.json``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Literal, Protocol, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from shared.wire import Candidate, Tokens, Uplink

SUMMARY, DECISIONS, REPORT, REQUESTS = "summary.json", "decisions.jsonl", "report.html", "requests.jsonl"
FIGURES = "figures"
# The figures that a mission may have, for print.
DRAWN = tuple(
    f"{FIGURES}/{name}.{kind}"
    for name in ("latency-map", "latency-steps", "losses", "tokens", "visits", "deciders")
    for kind in ("svg", "pdf")
)
LATE_SLACK_MS = 50.0
# Reasons with which the LLM was asked, and its answer or its silence not used.
_ASKED_IN_VAIN = frozenset(
    {"llm_timeout", "llm_status", "llm_error", "answer_format", "answer_sensor", "answer_velocity"}
)

Line = TypeVar("Line")
DecidedBy = Literal["llm", "guided", "value", "policy", "onboard"]


class BadUse(Exception):
    """What was asked for cannot be done; the text says what to ask for instead."""


class Record(BaseModel):
    """Files written by an older version may lack a field and those by a newer one have more."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Decision(Record):
    """One decision and what came of it.

    ``position`` is where it was taken, metres. ``source`` is ``onboard`` when the UAV decided itself, and then
    ``decision_id``, ``tokens``, ``deadline_ms`` and ``rtt_ms`` are ``null`` and ``attempts``, ``request_bytes``,
    ``response_bytes`` and ``attention_bytes`` 0. ``rtt_ms`` includes retries; ``lost_packets`` and ``cost`` are this
    UAV's share.
    """

    step: int
    uav_id: int
    position: tuple[float, float]
    sensor_id: int
    velocity: int
    source: DecidedBy
    reason: str | None = None
    model: str | None = None
    decision_id: str | None = None
    top_k: list[Candidate] = []
    tokens: Tokens | None = None
    latency_ms: dict[str, float] = {}
    deadline_ms: int | None = None
    rtt_ms: float | None = None
    attempts: int = 0
    request_bytes: int = 0
    response_bytes: int = 0
    attention_bytes: int = 0
    failed: bool = False
    collected: int = 0
    lost_packets: int = 0
    cost: float = 0.0


class BySource(Record):
    """Decisions, by who took them; ``value`` is what the edge's modules learned, ``policy`` its LLM-free policy."""

    llm: int = 0
    guided: int = 0
    value: int = 0
    policy: int = 0
    onboard: int = 0

    def present(self) -> dict[str, int]:
        """Those who took any, most decisions first."""
        return dict(sorted(((k, n) for k, n in self.model_dump().items() if n), key=lambda item: -item[1]))


def told_sources(by_source: BySource) -> str:
    """Who decided, as people write it: ``87 llm, 3 policy``."""
    return ", ".join(f"{count} {name}" for name, count in by_source.present().items()) or "none"


class TokenSummary(Record):
    """Means over the decisions that the edge took, ``null`` when it took none or did not say.

    ``cached_pct`` is what the LLM server read from its prefix cache, of the prompt tokens that it counted itself.
    """

    prompt_mean: float | None = None
    uncompressed_mean: float | None = None
    saved_pct: float | None = None
    cached_mean: float | None = None
    cached_pct: float | None = None
    state_mean: float | None = None
    state_uncompressed_mean: float | None = None
    state_saved_pct: float | None = None


class RoundTrips(Record):
    """Percentiles over the decisions that the edge took, milliseconds."""

    p50: float | None = None
    p99: float | None = None


class Flown(Record):
    """The mission's facts that no single decision holds.

    ``steps`` were asked for and ``steps_flown`` flown; ``policy`` is ``edge`` or a local policy's name;
    ``deadline_ms`` is what the edge said last, or what it was asked for. ``uplink`` says how much of a report was sent,
    ``null`` where no edge was asked.
    """

    scenario: str
    seed: int
    steps: int
    steps_flown: int
    uavs: int
    sensors: int
    policy: str
    edge: str | None
    uplink: Uplink | None = None
    mission_id: str
    mode: str | None
    model: str | None
    deadline_ms: int | None
    interrupted: bool
    started_at: datetime
    duration_s: float
    version: str
    command: str


class Summary(Flown):
    """``summary.json``.

    ``lost_packets`` and ``loss_events`` are by policy: ``aic_vds`` (or the local policy that was flown), ``eof``
    and ``wqcs``, all over ``steps_flown`` steps of one world. ``late`` counts decisions whose round trip took more than
    their deadline + 50 ms. ``jain`` is Jain's index of the sensors' served visits, ``null`` when none was served;
    ``failures`` are failed transmissions; ``llm_asked`` counts decisions for which the LLM was asked, in vain or not.
    ``uplink_bytes_mean`` is a decision's request, ``attention_bytes_mean`` what its UAV was sent to prune by.
    """

    decisions: int
    by_source: BySource
    by_reason: dict[str, int]
    lost_packets: dict[str, int]
    loss_events: dict[str, int]
    failures: int
    late: int
    tokens: TokenSummary
    rtt_ms: RoundTrips
    uplink_bytes_mean: float | None
    attention_bytes_mean: float | None = None
    jain: float | None
    llm_asked: int = 0


class Tally(Protocol):
    """One step's losses, as ``simulator.world.StepTally`` counts them."""

    @property
    def failures(self) -> int: ...
    @property
    def overflows(self) -> int: ...
    @property
    def lost_packets(self) -> int: ...


def refuse_old_result(out: Path, overwrite: bool, result: str = SUMMARY) -> None:
    """Raises ``BadUse`` when ``out`` is no folder, or holds a result that may not be overwritten."""
    with naming_out(out):
        if out.exists() and not out.is_dir():
            raise BadUse(f"--out {out} is a file; name a folder")
        held = (out / result).exists()
    if held and not overwrite:
        what = "a mission's result" if result == SUMMARY else f"a {result}"
        raise BadUse(f"--out {out} holds {what} already; choose another folder or add --overwrite")


def fresh_folder(out: Path, stale: Iterable[str] = (SUMMARY, REPORT, REQUESTS, *DRAWN)) -> None:
    """Make the folder, without the earlier mission's files that would stand beside another's decisions.

    Raises:
        BadUse: it cannot be written.
    """
    with naming_out(out):
        out.mkdir(parents=True, exist_ok=True)
        for name in stale:
            (out / name).unlink(missing_ok=True)


@contextmanager
def naming_out(out: Path) -> Iterator[None]:
    """Within, an ``OSError`` becomes a ``BadUse`` that names the option to change."""
    try:
        yield
    except OSError as error:
        at = f" ({error.filename})" if error.filename and str(error.filename) != str(out) else ""
        raise BadUse(f"--out {out}: {error.strerror or error}{at}") from None


class DecisionLog:
    """Appends decisions to a new file and flushes each, so that a killed mission loses half a line at most.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file: IO[str] = path.open("w", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._file.close()

    def append(self, decision: Decision) -> None:
        """Write one line."""
        self._file.write(decision.model_dump_json() + "\n")
        self._file.flush()

    def keep(self, decisions: Iterable[Decision]) -> None:
        """Make these the file's only lines, after an interrupt that may have come in the middle of one."""
        self._file.seek(0)
        self._file.truncate()
        self._file.writelines(decision.model_dump_json() + "\n" for decision in decisions)
        self._file.flush()


def read_decisions(path: Path) -> list[Decision]:
    """The decisions of a ``decisions.jsonl``; a last line cut off by a crash is left out.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line that is not the last is no decision; the text names the line.
    """
    return read_lines(path, TypeAdapter(Decision))


def read_lines(path: Path, line: TypeAdapter[Line]) -> list[Line]:
    """The lines of a JSON Lines file; a last one cut off by a crash is left out.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line that is not the last is none; the text names it.
    """
    lines = path.read_bytes().split(b"\n")
    parsed = []
    for number, text in enumerate(lines, start=1):
        if not text.strip():
            continue
        try:
            parsed.append(line.validate_json(text))
        except ValidationError as error:
            # Every whole line ends in a newline, so only the remainder after the last one may be torn.
            if number == len(lines):
                break
            raise ValueError(f"{path}, line {number}: {error.errors(include_url=False)[0]['msg']}") from None
    return parsed


def visits_per_sensor(decisions: Iterable[Decision], sensors: int) -> list[int]:
    """Served visits of each of ``sensors`` sensors."""
    served = Counter(d.sensor_id for d in decisions if not d.failed)
    return [served[j] for j in range(sensors)]


def jain_index(values: Sequence[float]) -> float | None:
    """Jain's fairness index, 1/n (one has all) to 1 (all alike); ``None`` when every value is 0."""
    squares = sum(v * v for v in values)
    return sum(values) ** 2 / (len(values) * squares) if squares else None


def summarise(flown: Flown, decisions: Sequence[Decision], tallies: Mapping[str, Sequence[Tally]]) -> Summary:
    """The summary of one mission.

    Args:
        flown: the mission's facts.
        decisions: every decision of its ``steps_flown`` steps.
        tallies: per policy, one tally a step flown.
    """
    from_edge = [d for d in decisions if d.rtt_ms is not None]
    return Summary(
        **flown.model_dump(),
        decisions=len(decisions),
        by_source=BySource.model_validate(Counter(d.source for d in decisions)),
        by_reason=dict(sorted(Counter(d.reason for d in decisions if d.reason is not None).items())),
        lost_packets={name: int(sum(t.lost_packets for t in tally)) for name, tally in tallies.items()},
        loss_events={name: int(sum(t.failures + t.overflows for t in tally)) for name, tally in tallies.items()},
        failures=sum(d.failed for d in decisions),
        late=sum(_is_late(d) for d in from_edge),
        tokens=_tokens([d.tokens for d in from_edge if d.tokens is not None]),
        rtt_ms=round_trips(decisions),
        uplink_bytes_mean=mean([d.request_bytes for d in from_edge]),
        attention_bytes_mean=mean([d.attention_bytes for d in from_edge]),
        jain=jain_index(visits_per_sensor(decisions, flown.sensors)),
        llm_asked=sum(asked_llm(d) for d in decisions),
    )


def round_trips(decisions: Iterable[Decision]) -> RoundTrips:
    """Over the decisions that the edge took."""
    trips = [d.rtt_ms for d in decisions if d.rtt_ms is not None]
    return RoundTrips(p50=_percentile(trips, 50), p99=_percentile(trips, 99))


def asked_llm(decision: Decision) -> bool:
    """Whether the LLM was asked for it, in vain or not."""
    if decision.source in ("llm", "guided") or decision.reason in _ASKED_IN_VAIN:
        return True
    return decision.tokens is not None and decision.tokens.server_prompt is not None


def _is_late(decision: Decision) -> bool:
    if decision.rtt_ms is None or decision.deadline_ms is None:
        return False
    return decision.rtt_ms > decision.deadline_ms + LATE_SLACK_MS


def _tokens(counts: list[Tokens]) -> TokenSummary:
    prompt, uncompressed = mean([t.prompt for t in counts]), mean([t.uncompressed for t in counts])
    state, state_uncompressed = mean([t.state for t in counts]), mean([t.state_uncompressed for t in counts])
    return TokenSummary(
        prompt_mean=prompt,
        uncompressed_mean=uncompressed,
        saved_pct=_saved_pct(prompt, uncompressed),
        cached_mean=mean([t.cached for t in counts if t.cached is not None]),
        cached_pct=_cached_pct(counts),
        state_mean=state,
        state_uncompressed_mean=state_uncompressed,
        state_saved_pct=_saved_pct(state, state_uncompressed),
    )


def mean(values: Sequence[float]) -> float | None:
    """The mean, ``None`` of nothing."""
    return sum(values) / len(values) if values else None


def _cached_pct(counts: list[Tokens]) -> float | None:
    told = [(t.cached, t.server_prompt) for t in counts if t.cached is not None and t.server_prompt]
    return 100 * sum(cached for cached, _ in told) / sum(prompt for _, prompt in told) if told else None


def _saved_pct(kept: float | None, whole: float | None) -> float | None:
    return 100 * (1 - kept / whole) if kept is not None and whole else None


def _percentile(values: list[float], q: float) -> float | None:
    return float(np.percentile(values, q)) if values else None
