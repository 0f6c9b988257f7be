"""The queue in front of a store that fails: its pauses, its log and its answers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

import pytest

from service.observability.metrics import Metrics
from service.storage.group_commit import GroupCommit
from service.storage.leases import LeaseLost
from service.storage.operations import Change, Deleted, Done, WriteFailed
from tests.support.waiting import soon

FULL = WriteFailed("the disk is full")


class Disk:
    """A writer that fails as it is told, then writes."""

    def __init__(self, *faults: Exception | None) -> None:
        self.faults = list(faults)
        self.written: list[str] = []

    def write(self, changes: Sequence[Change], done: Done) -> None:
        fault = self.faults.pop(0) if self.faults else None
        if fault is None:
            self.written += [change.mission_id for change in changes]
        asyncio.get_running_loop().call_soon(done, fault)

    def close(self) -> None:
        """Nothing is open."""


def queue(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> tuple[GroupCommit, list[float], list[tuple[str, int]]]:
    """A queue, its pauses before transactions, which take no time, and the missions that it has lost."""
    pauses, lost, loop = list[float](), list[tuple[str, int]](), asyncio.get_running_loop()
    commits = GroupCommit(disk, Metrics(), lambda mission_id, epoch: lost.append((mission_id, epoch)), lambda: None)
    later = loop.call_later

    def call_later(delay: float, call: Callable[..., object], *args: object) -> asyncio.TimerHandle:
        if getattr(call, "__self__", None) is commits:
            pauses.append(delay)
            delay = 0.0
        return later(delay, call, *args)

    monkeypatch.setattr(loop, "call_later", call_later)
    return commits, pauses, lost


async def test_after_a_store_works_again_its_pauses_are_short_again(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(FULL, FULL, FULL, None, FULL)
    commits, pauses, _ = queue(disk, monkeypatch)
    for number, name in enumerate("ab"):
        commits.add(Deleted(name))
        await soon(lambda number=number: len(disk.written) == number + 1)  # type: ignore[misc]
        await soon(lambda: not commits.failing)
    # A change lingers, then come the pauses after its failures.
    assert pauses == [0.25, 0.25, 0.5, 1.0, 0.25, 0.25]


async def test_failures_of_one_cause_in_a_row_are_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = Disk(FULL, FULL, WriteFailed("the disk is gone"), FULL)
    commits, _, _ = queue(disk, monkeypatch)
    commits.add(Deleted("a"))
    await soon(lambda: disk.written == ["a"] and not commits.failing)
    failures = [record.getMessage().split(": ")[1] for record in caplog.records if record.levelname == "ERROR"]
    assert failures == ["the disk is full", "the disk is gone", "the disk is full"]


async def test_only_the_changes_of_a_lost_missions_lost_epoch_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(LeaseLost([("a", 1)]))
    commits, _, lost = queue(disk, monkeypatch)
    for change in (Deleted("b", 1), Deleted("a", 1), Deleted("a", 2)):
        commits.add(change)
    assert await commits.stored(60.0)
    assert (disk.written, lost, commits.failing) == (["b", "a"], [("a", 1)], False)


async def test_a_failure_is_a_fault_only_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(WriteFailed("the file was deleted", lasting=True))
    commits, _, _ = queue(disk, monkeypatch)
    commits.add(Deleted("a"))
    assert not await commits.stored(60.0)
    assert commits.fault == "the file was deleted"
    await soon(lambda: disk.written == ["a"] and not commits.failing)
    assert commits.fault is None
    disk.faults.append(FULL)
    commits.add(Deleted("b"))
    assert not await commits.stored(60.0)
    assert commits.failing and commits.fault is None


@pytest.mark.parametrize(("failures", "written"), [(1, ["a"]), (2, [])])
async def test_a_queue_that_is_closed_is_tried_twice(failures: int, written: list[str]) -> None:
    """The first try may meet a connection to a database that has ended."""
    disk, recoveries = Disk(*[FULL] * failures), list[None]()
    commits = GroupCommit(disk, Metrics(), lambda mission_id, epoch: None, lambda: recoveries.append(None))
    commits.add(Deleted("a"))
    assert await commits.close(asyncio.get_running_loop().time() + 10)
    assert (disk.written, len(recoveries)) == (written, len(written))
