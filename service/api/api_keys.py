"""API keys: who may ask the edge for what. ``aicvds keys`` makes them, and keeps their hashes in a file.

A key is 256 random bits, so a plain SHA-256 of it tells nobody the key; it is shown once, when it is made.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import logging
import os
import secrets
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

log = logging.getLogger(__name__)

# `decide`: ask for decisions, report outcomes, read. `admin`: make, guide and delete missions.
Scope = Literal["decide", "admin"]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]

_PREFIX = "aicvds_"
# A changed file counts after so many seconds.
_STALE_S = 1.0
_MOST_KEYS = 1000


class BadKeys(Exception):
    """The file of keys cannot be used; the text says why, never what is in it."""


class ApiKey(BaseModel):
    """One key, without the key: its name, what it may do, how often a minute, and the hash that it is known by."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Name
    scopes: frozenset[Scope] = Field(min_length=1)
    per_minute: int = Field(ge=1, le=1_000_000)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class KeyFile(BaseModel):
    """What is in the file."""

    model_config = ConfigDict(extra="forbid")

    keys: list[ApiKey] = Field(default_factory=list, max_length=_MOST_KEYS)

    @classmethod
    def read(cls, path: Path) -> KeyFile:
        """Raises ``BadKeys``."""
        try:
            return cls.model_validate_json(path.read_bytes())
        except OSError as error:
            raise BadKeys(f"{path}: {error.strerror or error}") from None
        except ValidationError as error:
            fault = error.errors()[0]
            at = ".".join(map(str, fault["loc"])) or "the file"
            raise BadKeys(f"{path}: {at}: {fault['msg']}") from None

    def write(self, path: Path) -> None:
        """Replace the file as a whole, readable by its owner alone; raises ``BadKeys``.

        A file that is there keeps its owner, group and mode: the edge may be another user.
        """
        part = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
                file.write(self.model_dump_json(indent=1) + "\n")
                if path.exists():
                    found = path.stat()
                    os.fchown(file.fileno(), found.st_uid, found.st_gid)
                    os.fchmod(file.fileno(), stat.S_IMODE(found.st_mode))
            os.replace(part, path)
        except OSError as error:
            raise BadKeys(f"{path}: {error.strerror or error}") from None

    def add(self, name: str, scopes: frozenset[Scope], per_minute: int) -> str:
        """A new key, to be shown to its owner once; raises ``BadKeys`` for a name that is taken, or too many."""
        if any(key.name == name for key in self.keys):
            raise BadKeys(f"there is a key {name} already: remove it first, or choose another name")
        if len(self.keys) >= _MOST_KEYS:
            raise BadKeys(f"there are {_MOST_KEYS} keys already")
        shown = _PREFIX + secrets.token_urlsafe(32)
        self.keys.append(ApiKey(name=name, scopes=scopes, per_minute=per_minute, sha256=hash_of(shown)))
        return shown

    def remove(self, name: str) -> None:
        """Raises ``BadKeys`` where there is none of that name."""
        left = [key for key in self.keys if key.name != name]
        if len(left) == len(self.keys):
            raise BadKeys(f"there is no key {name}")
        self.keys = left


@contextmanager
def editing(path: Path) -> Iterator[KeyFile]:
    """The file's keys to change, written at the end; one edits at a time. Raises ``BadKeys``."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = path.with_name(f".{path.name}.lock").open("w")
    except OSError as error:
        raise BadKeys(f"{path}: {error.strerror or error}") from None
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        known = KeyFile.read(path) if path.exists() else KeyFile()
        yield known
        known.write(path)


def hash_of(key: str) -> str:
    """SHA-256 of a key, in hexadecimal digits."""
    return hashlib.sha256(key.encode()).hexdigest()


class ApiKeys:
    """The keys of a file, read again when it changes; while it cannot be read, those known before count.

    Raises:
        BadKeys: at first it cannot be read, or holds none.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock = path, clock
        self._told = ""
        self._changed = self._stamp()
        self._keys = KeyFile.read(path).keys
        self._looked = clock()
        if not self._keys:
            raise BadKeys(f"{path} holds no key: nobody could ask. Make one with: aicvds keys add NAME --file {path}")

    def find(self, presented: str) -> ApiKey | None:
        """Whose key that is. Every key is compared, each in constant time."""
        self._refresh()
        hashed = hash_of(presented)
        found = None
        for key in self._keys:
            if hmac.compare_digest(key.sha256, hashed):
                found = key
        return found

    def _refresh(self) -> None:
        if self._clock() - self._looked < _STALE_S:
            return
        self._looked = self._clock()
        stamp = self._stamp()
        if stamp == self._changed:
            return
        try:
            self._keys = KeyFile.read(self._path).keys
        except BadKeys as error:
            # Tried again every second, and told once.
            if str(error) != self._told:
                self._told = str(error)
                log.error("the keys known before go on to count: %s", error)
        else:
            self._changed, self._told = stamp, ""
            log.info("%d keys read again", len(self._keys))

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino
