"""API keys and their scopes. ``aicvds keys`` makes keys and writes their hashes to a file.

A key is 256 random bits, so its plain SHA-256 does not reveal it. The key itself is shown once, when it is made.
"""

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

from shared.kit.text_files import text_of
from shared.kit.validation_messages import problem_of

log = logging.getLogger(__name__)

# `decide`: request decisions, report outcomes, read. `admin`: make, guide, delete missions. `readings`: report sensors.
Scope = Literal["decide", "admin", "readings"]
# A mission's ID, or the beginning of IDs and `*`.
Missions = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\*?$")]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]

_PREFIX = "aicvds_"
# Seconds between checks for changes of the file.
STALE_S = 1.0
MOST_KEYS = 1000
_MAX_BYTES = 4_000_000


class BadKeys(Exception):
    """The file of keys cannot be used; the message gives the reason and never the content."""


class ApiKey(BaseModel):
    """One key's record: its name, scopes, requests a minute, hash, and the missions that it is bound to, if it is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Name
    scopes: frozenset[Scope] = Field(min_length=1)
    per_minute: int = Field(ge=1, le=1_000_000)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    # Omitted where there is none: earlier edges refuse fields that they do not know.
    missions: tuple[Missions, ...] | None = Field(None, min_length=1, exclude_if=lambda bound: bound is None)

    def allows(self, mission_id: str) -> bool:
        """Whether the key may know of a mission."""
        bound = self.missions or ("*",)
        return any(mission_id == one or (one[-1] == "*" and mission_id.startswith(one[:-1])) for one in bound)


class KeyFile(BaseModel):
    """The content of the file."""

    model_config = ConfigDict(extra="forbid")

    keys: list[ApiKey] = Field(default_factory=list, max_length=MOST_KEYS)

    @classmethod
    def read(cls, path: Path) -> "KeyFile":
        """Read the file; raises ``BadKeys``."""
        try:
            return cls.model_validate_json(text_of(path, _MAX_BYTES, BadKeys))
        except ValidationError as error:
            fault = error.errors()[0]
            raise BadKeys(f"{path}: {'.'.join(map(str, fault['loc'])) or 'the file'}: {problem_of(fault)}") from None

    def write(self, path: Path) -> None:
        """Replace the file atomically, readable only by its owner; raises ``BadKeys``.

        An existing file keeps its owner, group and mode, because the edge may run as another user.
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

    def add(self, name: str, scopes: frozenset[Scope], per_minute: int, missions: tuple[str, ...] | None = None) -> str:
        """Add a key, by default for all missions; returns the key itself.

        Raises:
            BadKeys: the name is in use, or there are too many keys.
        """
        if any(key.name == name for key in self.keys):
            raise BadKeys(f"there is already a key {name}: remove it first, or choose another name")
        if len(self.keys) >= MOST_KEYS:
            raise BadKeys(f"there are already {MOST_KEYS} keys")
        shown = _PREFIX + secrets.token_urlsafe(32)
        sha256 = hash_of(shown)
        self.keys.append(ApiKey(name=name, scopes=scopes, per_minute=per_minute, sha256=sha256, missions=missions))
        return shown

    def remove(self, name: str) -> None:
        """Remove the key of that name; raises ``BadKeys`` if there is none."""
        left = [key for key in self.keys if key.name != name]
        if len(left) == len(self.keys):
            raise BadKeys(f"there is no key {name}")
        self.keys = left


@contextmanager
def editing(path: Path) -> Iterator[KeyFile]:
    """The file's keys for changes, locked, and written back at the end. Raises ``BadKeys``."""
    try:
        path = path.resolve()  # A link stays one: an edge may read its target.
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
    """The keys of a file, which is read again when it changes; while it cannot be read, the previous keys apply.

    Raises:
        BadKeys: the file cannot be read at first, or has no key.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock = path, clock
        self._last_error = ""
        self._read_stamp = self._stamp()
        self._keys = KeyFile.read(path).keys
        self._checked_at = clock()
        if not self._keys:
            raise BadKeys(
                f"{path} has no key, so every request would fail. Make one with: aicvds keys add NAME --file {path}"
            )

    @property
    def lost(self) -> bool:
        """Whether the file cannot be read, so that the previous keys apply."""
        self._refresh()
        return self._last_error != ""

    def find(self, presented: str) -> ApiKey | None:
        """The record of a presented key, if there is one. Every key is compared, each in constant time."""
        self._refresh()
        hashed = hash_of(presented)
        found = None
        for key in self._keys:
            if hmac.compare_digest(key.sha256, hashed):
                found = key
        return found

    def _refresh(self) -> None:
        if self._clock() - self._checked_at < STALE_S:
            return
        self._checked_at = self._clock()
        stamp = self._stamp()
        if stamp == self._read_stamp and not self._last_error:
            return
        try:
            self._keys = KeyFile.read(self._path).keys
        except BadKeys as error:
            # The file is tried again every second; the same error is logged once.
            if str(error) != self._last_error:
                self._last_error = str(error)
                log.error("the previous keys still apply: %s", error)
        else:
            self._read_stamp, self._last_error = stamp, ""
            log.info("read %d keys again", len(self._keys))

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            found = self._path.stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino
