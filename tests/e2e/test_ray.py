"""Flights and worlds on a real Ray: as without it, whoever is killed."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor
from itertools import count, islice
from pathlib import Path

import pytest

from lab.commands import explore
from lab.executors import RayExecutor, executor, in_order
from lab.experiments.flight import FlightRecord, FlightStore
from lab.experiments.result import Result
from lab.experiments.runner import FLIGHTS, RESULT
from lab.experiments.schemes import local
from lab.exploration.rollouts import read_rollouts
from shared.kit.ray_connection import RayUnusable
from shared.world.scenario import SCENARIOS
from simulator.sites.site import Site
from tests.support.tiny_flights import declared, run_in
from tests.support.waiting import PATIENCE_S, until

pytestmark = pytest.mark.long

# A run of experiments on a Ray, to be killed.
DRIVER = """
import sys
from pathlib import Path
from tests.e2e.test_ray import fly

fly(Path(sys.argv[1]), sys.argv[2])
"""
SCHEMES, SEEDS = ("eof", "random", "madqn"), 16


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Ray on this machine with two cores, with this process's token; it takes many seconds to start."""
    command = [sys.executable, "-m", "tests.support.ray_here", "2"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        yield process.stdout.readline().decode().strip()
        process.communicate(timeout=PATIENCE_S)


@pytest.fixture(scope="class")
def on_ray(address: str) -> Iterator[Executor]:
    """An executor there, with one connection for all: the workers of a connection take seconds to start."""
    with executor(1, address) as pool:
        yield pool


def fly(out: Path, ray: str | None) -> None:
    """An experiment of cheap flights, on that Ray or without."""
    run = run_in(out, seeds=SEEDS, sites={"paper": Site(SCENARIOS["paper"])})
    run.ray = ray
    run.make([declared(*map(local, SCHEMES))])


def flights(out: Path) -> dict[str, FlightRecord]:
    """The stored flights, without what differs between any two runs: when they were flown and how long it took."""
    store = FlightStore(out / FLIGHTS)
    found = {path.name.partition(".")[0]: store.load(path.name.partition(".")[0]) for path in stored(out)}
    timeless = {"flown_at": 0, "duration_s": 0.0}
    return {key: flight.model_copy(update=timeless) for key, flight in found.items() if flight is not None}


def stored(out: Path) -> dict[Path, int]:
    """Every flight's file and its time."""
    return {path: path.stat().st_mtime_ns for path in (out / FLIGHTS).glob("*.json.gz")}


def killed_at_first(folder: Path, number: int) -> int:
    """Leave a file, and kill the own process at the first call with a number that is odd."""
    attempts = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{attempts}").touch()
    if number % 2 and not attempts:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def test_a_killed_run_goes_on_and_its_flights_equal_those_without_ray(address: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", DRIVER, str(tmp_path / "ray"), address]
    driver = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: len(stored(tmp_path / "ray")) >= 5 or driver.poll() is not None)
    finally:
        driver.kill()
        driver.wait()
    before = stored(tmp_path / "ray")
    assert 5 <= len(before) < len(SCHEMES) * SEEDS
    fly(tmp_path / "ray", address)
    assert before.items() <= stored(tmp_path / "ray").items(), "a flight was flown twice"
    fly(tmp_path / "plain", None)
    assert flights(tmp_path / "ray") == flights(tmp_path / "plain")
    alone, together = (
        Result.model_validate_json((tmp_path / run / "tiny" / RESULT).read_bytes()) for run in ("plain", "ray")
    )
    assert together.model_copy(update={"created_at": alone.created_at}) == alone


def test_explored_worlds_equal_those_without_ray(address: str, tmp_path: Path) -> None:
    written = []
    for name, ray in (("plain", []), ("ray", ["--ray", address])):
        out = tmp_path / f"{name}.gz"
        assert explore.main(["--out", str(out), "--missions", "0", "--untaught", "2", *ray]) == 0
        written.append(list(read_rollouts(out)[1]))
    assert written[0] == written[1]


class TestExecutor:
    def test_only_the_tasks_of_a_killed_worker_are_repeated(self, on_ray: Executor, tmp_path: Path) -> None:
        futures = [on_ray.submit(killed_at_first, tmp_path, number) for number in range(6)]
        assert [future.result() for future in futures] == [0, 1, 4, 9, 16, 25]
        attempts = [len(list(tmp_path.glob(f"{number}-*"))) for number in range(6)]
        assert attempts == [1, 2, 1, 2, 1, 2]

    def test_the_error_of_a_task_is_the_one_that_it_raised(self, on_ray: Executor) -> None:
        raised = on_ray.submit(int, "seven").exception()
        assert type(raised) is ValueError
        assert str(raised) == "invalid literal for int() with base 10: 'seven'"

    def test_a_map_is_in_order_and_does_not_read_all_that_it_is_given(self, on_ray: Executor) -> None:
        endless = in_order(on_ray, math.factorial, count(), ahead=4)
        assert list(islice(endless, 9)) == [math.factorial(n) for n in range(9)]

    def test_a_worker_with_another_release_is_refused(self, on_ray: Executor) -> None:
        assert isinstance(on_ray, RayExecutor)
        with pytest.raises(RayUnusable, match=r"a worker has aic-vds .*, this machine 0\.0\.0"):
            RayExecutor("0.0.0").submit(math.factorial, 3).result()
