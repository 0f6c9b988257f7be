"""Functions that numba compiles to machine code at their first call, and that are plain Python where it is missing."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

try:
    import numba
except ModuleNotFoundError:
    # Not installed with the simulator alone.
    numba = None  # type: ignore[assignment]

_P = ParamSpec("_P")
_R = TypeVar("_R")

# Other threads of Python run meanwhile. Without numba's run-time (``_nrt``) a function makes no array, and reading one
# counts no reference, which would take most of the time.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
# Where compiled functions are kept: beside their module, else in the user's folder of caches.
_PLACES = "shared.kit.compiled_cache.BesideModule,UserWideCacheLocator"
# Two threads may each import a module of compiled functions at a time, and numba's setting is one for all.
_placing = threading.Lock()


def require_numba() -> None:
    """Raise ``ModuleNotFoundError`` where numba is not installed (extra ``service`` or ``planner``)."""
    if numba is None:
        raise ModuleNotFoundError("No module named 'numba'", name="numba")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that Python calls; it is kept, so that later processes need not compile it."""
    if numba is None:
        return function
    config: Any = numba.config
    with _placing:
        before, config.CACHE_LOCATOR_CLASSES = config.CACHE_LOCATOR_CLASSES, _PLACES
        try:
            made: Callable[_P, _R] = numba.njit(cache=True, **_OPTIONS)(function)
        except RuntimeError:
            # No folder can be written.
            made = numba.njit(**_OPTIONS)(function)
        finally:
            config.CACHE_LOCATOR_CLASSES = before
    return made


def inlined(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A part of compiled functions."""
    if numba is None:
        return function
    made: Callable[_P, _R] = numba.njit(forceinline=True, **_OPTIONS)(function)
    return made
