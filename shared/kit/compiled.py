"""Functions that numba compiles to machine code at their first call, and that are plain Python where it is missing."""

import threading
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

try:
    import numba
except ModuleNotFoundError:
    # The extra `simulator` does not install it.
    numba = None  # type: ignore[assignment]

_P = ParamSpec("_P")
_R = TypeVar("_R")

# nogil: other Python threads run meanwhile. _nrt off: functions create no arrays and count no references, which would
# take most of the time.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
# numba's cache locators: the module's __pycache__, else the user's cache folder.
_LOCATORS = "shared.kit.compiled_cache.ModuleCacheLocator,UserWideCacheLocator"
# Two threads may import modules of compiled functions at the same time, and numba's setting is global.
_placing = threading.Lock()


def require_numba() -> None:
    """Raise ``ModuleNotFoundError`` where numba is not installed (extra ``service`` or ``planner``)."""
    if numba is None:
        raise ModuleNotFoundError("No module named 'numba'", name="numba")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function for calls from Python; its machine code is cached for later processes."""
    if numba is None:
        return function
    config: Any = numba.config
    with _placing:
        before, config.CACHE_LOCATOR_CLASSES = config.CACHE_LOCATOR_CLASSES, _LOCATORS
        try:
            made: Callable[_P, _R] = numba.njit(cache=True, **_OPTIONS)(function)
        except RuntimeError:
            # No folder can be written.
            made = numba.njit(**_OPTIONS)(function)
        finally:
            config.CACHE_LOCATOR_CLASSES = before
    return made


def inlined(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that is inlined into compiled functions."""
    if numba is None:
        return function
    made: Callable[_P, _R] = numba.njit(forceinline=True, **_OPTIONS)(function)
    return made
