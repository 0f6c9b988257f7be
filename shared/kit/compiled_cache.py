"""The cache locator of compiled functions for :mod:`shared.kit.compiled`."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import InTreeCacheLocator

_RULES = Path(__file__).parents[1] / "world"


@cache
def _stamp(folder: Path) -> bytes:
    modules = sorted({*folder.glob("*.py"), *_RULES.glob("*.py")})
    return hashlib.sha256(b"".join(module.read_bytes() for module in modules)).digest()


class ModuleCacheLocator(InTreeCacheLocator):
    """A module's ``__pycache__``, which may be read-only if it has the function, as in an image.

    A function is recompiled after a change in its folder or in ``shared/world``, where its callees are.
    """

    def get_source_stamp(self) -> bytes:
        """A hash of the modules of both folders."""
        return _stamp(Path(self._py_file).parent)

    def get_disambiguator(self) -> str:
        """The line, and the beginning of the hash: numba would unpickle what other sources left before it compares."""
        return f"{super().get_disambiguator()}.{self.get_source_stamp().hex()[:12]}"  # type: ignore[no-untyped-call]

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """A function's locator; None if the folder is read-only and has no cached code of it."""
        own: Any = cls(py_func, py_file)
        kept = Path(own.get_cache_path()).glob(f"{Path(py_file).stem}.{py_func.__qualname__}-*.nbi")
        writable: Any = super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]
        return writable or (own if any(kept) else None)
