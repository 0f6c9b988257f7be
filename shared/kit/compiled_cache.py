"""The cache locator of compiled functions for :mod:`shared.kit.compiled`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core.caching import InTreeCacheLocator

_RULES = Path(__file__).parents[1] / "world"


class ModuleCacheLocator(InTreeCacheLocator):
    """A module's ``__pycache__``, which may be read-only if it has the function, as in an image.

    A function is recompiled after a change in its folder or in ``shared/world``, where its callees are.
    """

    def get_source_stamp(self) -> bytes:
        """A hash of the modules of both folders."""
        modules = sorted({*Path(self._py_file).parent.glob("*.py"), *_RULES.glob("*.py")})
        return hashlib.sha256(b"".join(module.read_bytes() for module in modules)).digest()

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """A function's locator; None if the folder is read-only and has no cached code of it."""
        own: Any = cls(py_func, py_file)
        kept = Path(own.get_cache_path()).glob(f"{Path(py_file).stem}.{py_func.__qualname__}-*.nbi")
        writable: Any = super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]
        return writable or (own if any(kept) else None)
