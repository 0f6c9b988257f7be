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
_FUSED: dict[str, Any] = {"fastmath": {"contract"}}
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
    return _compiled(function, {})


def compiled_fused(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """As :func:`compiled`, with fused products and sums: faster, and the last bits depend on the processor."""
    return _compiled(function, _FUSED)


def inlined(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that is inlined into compiled functions."""
    return function if numba is None else _made(function, {"forceinline": True})


def inlined_fused(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that is inlined into those of :func:`compiled_fused`."""
    return function if numba is None else _made(function, {"forceinline": True, **_FUSED})


def _compiled(function: Callable[_P, _R], options: dict[str, Any]) -> Callable[_P, _R]:
    if numba is None:
        return function
    config: Any = numba.config
    with _placing:
        before, config.CACHE_LOCATOR_CLASSES = config.CACHE_LOCATOR_CLASSES, _LOCATORS
        try:
            return _made(function, {"cache": True, **options})
        except RuntimeError:
            # No folder can be written.
            return _made(function, options)
        finally:
            config.CACHE_LOCATOR_CLASSES = before


def _made(function: Callable[_P, _R], options: dict[str, Any]) -> Callable[_P, _R]:
    made: Callable[_P, _R] = numba.njit(**_OPTIONS, **options)(function)
    return made
