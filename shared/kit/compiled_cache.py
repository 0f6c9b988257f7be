"""The place of compiled functions beside their module, for :mod:`shared.kit.compiled`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core.caching import InTreeCacheLocator

_RULES = Path(__file__).parents[1] / "world"


class BesideModule(InTreeCacheLocator):
    """The folder ``__pycache__`` beside a module, also one that is read-only but has the function, as in an image.

    A function is compiled anew after a change in its folder or in ``shared/world``, which have its callees.
    """

    def get_source_stamp(self) -> bytes:
        """A hash of the modules of both folders."""
        modules = sorted({*Path(self._py_file).parent.glob("*.py"), *_RULES.glob("*.py")})
        return hashlib.sha256(b"".join(module.read_bytes() for module in modules)).digest()

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The place of a function; None if the folder is read-only and has nothing of it."""
        own: Any = cls(py_func, py_file)
        kept = Path(own.get_cache_path()).glob(f"{Path(py_file).stem}.{py_func.__qualname__}-*.nbi")
        writable: Any = super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]
        return writable or (own if any(kept) else None)
