"""Who carries out a command's independent tasks: this process, others of this machine, or Ray on many machines."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from typing import Any, ParamSpec, Protocol, TypeVar

from shared.kit.ray_connection import RayUnusable, connected

# The number of times that a task whose worker dies is retried: a worker may be killed, or lack memory.
_RETRIES = 10
# Tasks of an ordered map whose results are not consumed yet: more than the cores of a cluster, and few enough for
# this process's memory.
_AHEAD = 256

A = TypeVar("A")
P = ParamSpec("P")
T = TypeVar("T")


@contextmanager
def executor(workers: int, ray: str | None) -> Iterator[Executor]:
    """Within the context, an executor of tasks; an exception within it ends the tasks that run.

    Args:
        workers: processes on this machine, of Ray too if that is started here.
        ray: ``local`` to start Ray on this machine, or the address of a cluster of which this machine is a part;
            ``None`` for processes without Ray.

    Raises:
        RayUnusable: Ray is not installed, or not at that address.
    """
    with _processes(workers) if ray is None else _ray(ray, workers) as chosen:
        yield chosen


class OrderedMap(Protocol):
    """Applies a function to every item, and yields the results in the items' order, as ``map`` does."""

    def __call__(self, function: Callable[[A], T], items: Iterable[A], /) -> Iterator[T]: ...


@contextmanager
def ordered_map(workers: int, ray: str | None) -> Iterator[OrderedMap]:
    """Within the context, a map over an :func:`executor`; over this process with one worker and without Ray."""
    if workers == 1 and ray is None:
        yield map
        return
    with executor(workers, ray) as pool:
        yield partial(in_order, pool)


def in_order(pool: Executor, function: Callable[[A], T], items: Iterable[A], /, *, ahead: int = _AHEAD) -> Iterator[T]:
    """The results in the items' order; at most ``ahead`` items are read before their results are."""
    waiting = deque[Future[T]]()
    for item in items:
        waiting.append(pool.submit(function, item))
        if len(waiting) == ahead:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    # Forked children would inherit this process's threads and sockets.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_ignore_interrupts)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _ignore_interrupts() -> None:
    # Ctrl-C reaches every process of the terminal; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _ray(address: str, workers: int) -> Iterator[Executor]:
    with connected(address, workers):
        yield RayExecutor()


class RayExecutor(Executor):
    """Tasks on the workers of the Ray that this process is connected to, each with a core of its own.

    A task whose worker dies is run again, by another worker; a task that raises is not.

    Args:
        release: the version of this package that the workers must have; ``None``: that of this machine.
    """

    def __init__(self, release: str | None = None) -> None:
        import ray

        self._apply: Any = ray.remote(num_cpus=1, max_retries=_RETRIES)(_apply)
        self._release = release or version("aic-vds")

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """The future of a call, whose exception is the one that the function raised."""
        future = Future[T]()
        answer = self._apply.remote(self._release, fn, args, kwargs)
        answer.future().add_done_callback(partial(_settle, future))
        return future


def _apply(release: str, function: Callable[..., T], args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
    if (own := version("aic-vds")) != release:
        raise RayUnusable(f"--ray: a worker has aic-vds {own}, this machine {release}; install the same everywhere")
    return function(*args, **kwargs)


def _settle(future: Future[T], answered: Future[T]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    error = answered.exception()
    if error is None:
        future.set_result(answered.result())
    else:
        # Ray's own exception has the traceback of the worker as its text.
        future.set_exception(getattr(error, "cause", None) or error)
