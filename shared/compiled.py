"""Functions that numba compiles to machine code at their first call."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.caching import InTreeCacheLocator

_P = ParamSpec("_P")
_R = TypeVar("_R")

# Other threads of Python run meanwhile. Without numba's run-time (``_nrt``) a function makes no array, and reading one
# counts no reference, which would take most of the time.
_njit: Any = numba.njit
_OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False}
# Where compiled functions are kept: beside their module, else in the user's folder of caches.
_PLACES = f"{__name__}.BesideModule,UserWideCacheLocator"
# Two threads may each import a module of compiled functions at a time, and numba's setting is one for all.
_placing = threading.Lock()


class BesideModule(InTreeCacheLocator):
    """The folder ``__pycache__`` beside a module, also one that is read-only but has the function, as in an image.

    A function is compiled anew after a change of any module of its folder, because its callees may lie there.
    """

    def get_source_stamp(self) -> bytes:
        """A hash of the folder's modules."""
        modules = sorted(Path(self._py_file).parent.glob("*.py"))
        return hashlib.sha256(b"".join(module.read_bytes() for module in modules)).digest()

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The place of a function; None if the folder is read-only and has nothing of it."""
        own: Any = cls(py_func, py_file)
        kept = Path(own.get_cache_path()).glob(f"{Path(py_file).stem}.{py_func.__qualname__}-*.nbi")
        writable: Any = super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]
        return writable or (own if any(kept) else None)


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that Python calls; it is kept, so that later processes need not compile it."""
    config: Any = numba.config
    with _placing:
        before, config.CACHE_LOCATOR_CLASSES = config.CACHE_LOCATOR_CLASSES, _PLACES
        try:
            made: Callable[_P, _R] = _njit(cache=True, **_OPTIONS)(function)
        except RuntimeError:
            # No folder can be written.
            made = _njit(**_OPTIONS)(function)
        finally:
            config.CACHE_LOCATOR_CLASSES = before
    return made


def inlined(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A part of compiled functions."""
    made: Callable[_P, _R] = _njit(forceinline=True, **_OPTIONS)(function)
    return made
